"""Health records, heartbeat files, metrics, and the state of the fleet."""
