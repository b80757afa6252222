"""The paper's codec: vector quantisation with a shared codebook of tiles, and the tools that build codebooks."""
