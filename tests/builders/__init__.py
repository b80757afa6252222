"""Builders: test data, simulated peers and running parts of the system that several tests share."""
