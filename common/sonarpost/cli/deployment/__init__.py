"""Commands that put the services on a host: configuration files, systemd units, child processes."""
