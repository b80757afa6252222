"""Commands that put the services on a host: configuration files, systemd units, and all services in one terminal."""
