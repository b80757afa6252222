"""The paper's Table II, Fig. 2 and Fig. 3, measured again."""
