"""Target detection: filters, fusion, contacts."""
