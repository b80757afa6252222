"""Training of the classifier of candidates: examples, network, calibration."""
