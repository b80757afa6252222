"""Baseline codecs for comparison: Huffman, SPIHT, JPEG 2000, JPEG XL, AVIF, WebP."""
