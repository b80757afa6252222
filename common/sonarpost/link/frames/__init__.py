"""Wire formats of acoustic frames: v1, the paper's, and the contact record both carry."""
