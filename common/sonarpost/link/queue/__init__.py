"""The transmit queue of the vehicle: priorities, expiry, fairness, choice of rate."""
