"""Driver of the nanomodem v3 (NM3) of Newcastle University and of modems with its command set."""
