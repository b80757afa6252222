"""Emulated Micro-Modem."""
