"""Training mode: simulated contacts, vehicles and shore site."""
