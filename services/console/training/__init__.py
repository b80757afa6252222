"""Training mode: simulated contacts."""
