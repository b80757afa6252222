"""The paper's Fig. 6, measured again in the simulated channel."""
