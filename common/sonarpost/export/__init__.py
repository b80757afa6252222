"""Export of contacts to GeoJSON, CSV, KML, KMZ, GeoPackage and Cursor-on-Target.

`contacts.load_contacts` reads the folder that the c2 service writes. `formats` has one writer for each format, which
reads contacts one at a time.
`docs/reference/exports.md` describes the formats.
"""
