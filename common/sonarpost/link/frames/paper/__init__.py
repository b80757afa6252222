"""The paper's wire format: half-image frames and contact frames, sender and receiver."""
