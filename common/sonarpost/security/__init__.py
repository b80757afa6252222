"""Certificates of a fleet, access control of its routers, and checks of key files."""
