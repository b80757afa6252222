"""Export of contacts to GeoJSON, CSV, KML, KMZ, GeoPackage and Cursor-on-Target.

`contacts.load_contacts` reads the folder that the c2 service writes. The other modules convert its result.
`docs/reference/exports.md` describes the formats.
"""
