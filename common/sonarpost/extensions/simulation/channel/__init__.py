"""Acoustic channel.

`ChannelModel` computes propagation between modems. `ChannelSimulator` connects emulated modems by it, on simulated
time. `ChannelEmulator` runs a simulator in real time, with ports for hosts.
"""
