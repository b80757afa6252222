"""Codecs to compare with: Huffman, SPIHT, JPEG 2000, WebP, AVIF, JPEG XL."""
