"""Training of the network that estimates the scene without speckle."""
