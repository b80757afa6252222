"""What makes a service a process: configuration, Zenoh session, durable hand-off, health, logs."""
