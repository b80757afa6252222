"""Training and evaluation of the models of the codec emb."""
