"""Files for maps: GeoPackage, KML and KMZ of contacts, and the covered seabed."""
