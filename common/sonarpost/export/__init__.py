"""What c2 has accepted, in the formats of other programs: GeoJSON, KML and KMZ, CSV, Cursor-on-Target.

`accepted.load_accepted` reads the folder that c2 keeps; everything else takes what it returns.
`docs/reference/exports.md` describes the formats.
"""
