"""Zenoh sessions, the embedded router, TLS, and the connectivity of sites."""
