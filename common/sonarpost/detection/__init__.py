"""Target detection in side-scan surveys: filters, clutter normalisation, fusion, snippets."""
