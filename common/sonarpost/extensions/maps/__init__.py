"""Maps of whole recordings: mosaic and waterfalls of the seabed as GeoTIFF, covered seabed as polygons."""

from typing import Final

from sonarpost.cli.parsing.commands import CommandSpec

MOSAIC: Final = CommandSpec(
    "write a mosaic of the seabed as cloud-optimised GeoTIFF",
    "sonarpost.extensions.maps.command:add_mosaic",
    "line.xtf --out mosaic.tif --coverage coverage.geojson",
)
COVERAGE: Final = CommandSpec(
    "write the covered seabed as polygons",
    "sonarpost.extensions.maps.command:add_coverage",
    "line.xtf --out coverage.gpkg",
)
WATERFALL: Final = CommandSpec(
    "write the waterfall of each straight line as cloud-optimised GeoTIFF",
    "sonarpost.extensions.maps.command:add_waterfall",
    "line.xtf --out waterfalls",
)
EXPORT: Final = CommandSpec(
    "write the track of a recording as CSV or GeoJSON",
    "sonarpost.extensions.maps.track_export:add_options",
    "line.xtf --format geojson --out track.geojson",
)
