"""Authentication and encryption of acoustic frames: keys, tags, replay window."""
