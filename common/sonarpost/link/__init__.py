"""The acoustic link without input or output: wire formats, fragments, assembly."""
