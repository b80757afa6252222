"""The embedded wavelet codec. `codec.EmbCodec` is imported on use, since it brings a compiler with it."""
