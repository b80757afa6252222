"""Configuration of the target detection: the `[atd_stub]` table."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from sonarpost.codec.fitting import Fit
from sonarpost.codec.interface import MAX_SIDE_PX, MIN_SIDE_PX
from sonarpost.detection.settings import DetectorSettings, DetectorTuning
from sonarpost.detection.transmissions import MARGIN_AFTER_S, MARGIN_BEFORE_S
from sonarpost.errors import ConfigError
from sonarpost.runtime.retention import MaxBytes, RetentionConfig
from sonarpost.sonar.options import SurveyOptions, load_options

SnippetSidePx = Annotated[int, Field(ge=MIN_SIDE_PX, le=MAX_SIDE_PX)]


class AtdStubConfig(RetentionConfig, SurveyOptions):
    """Input files, detection, snippets and release, with the options for survey files.

    Attributes:
        mode: "survey" detects contacts in survey files; "snippets" sends image files as snippets (the paper's talker).
        input_dir: Folder that is polled.
        quarantine_dir: Where bad files are moved, each with its reason; by default `quarantine` in `input_dir`.
        poll_s: Interval between two polls of the folder.
        settle_s: A file is complete when its size and date have not changed for this long; at once with `NAME.done`
            beside it.
        require_done_marker: A file is complete only when `NAME.done` is beside it.
        confidence_threshold: Minimum ATD confidence (0 to 2) of a contact that is sent.
        max_contacts: Maximum number of contacts of one survey file, most confident first, up to 5000; 0 for 5000.
        max_in_flight: Maximum number of contacts between this service and their transmission. The others wait here and
            the most confident is released first. 0 for no limit, with a modem service that publishes no queue_state.
        detector: Object sizes, windows and limits of the detector, as for `--settings` of `sonarpost detect`.
        join_overlap_pings: Last pings of a file that are searched again together with the continuation file; also
            the overlap between parts of a long file. Twice a snippet's height is enough.
        join_timeout_s: How long a contact in the later half of these pings waits for the continuation file; 0 releases
            it at once.
        mask_transmissions: Whether pings that were recorded while the own modem transmitted are masked: no contact is
            detected in them.
        mask_before_s: Time before each transmission that is masked too: the tolerance of its reported start.
        mask_after_s: Time after each transmission that is masked too, for its reverberation.
        transmissions_file: JSON file to which the transmissions of the last 24 hours are written every minute, for
            `--transmissions` of `sonarpost detect`; by default none.
        snippet_height_px: Rows (along-track) of a snippet.
        snippet_width_px: Columns (across-track) of a snippet.
        snippet_pixel_m: Side of a snippet's pixels on the ground; 0 for the sonar's own, ping by sample.
        fit: In snippets mode, what is done with an image outside 16..512 px a side: "resize" keeps the aspect ratio and
            corrects the pixel size, "crop" sends the centre, "refuse" quarantines it.
        snippet_dir: Where each contact's snippet is stored with a text file beside it; by default nowhere.
        survey_options: File of survey options, as for `--options` of `sonarpost detect`. Its keys can be in this table
            instead; beside a file only `projected_crs` can, which replaces the one in the file.
        retain_days: Time after which a processed input file and a stored snippet are removed, and the entry of a
            processed file is deleted.
        max_bytes: Maximum size of the processed input files, and of the files in `snippet_dir`; above it the oldest are
            removed. Input files that are not processed and those in quarantine are never removed.
    """

    mode: Literal["survey", "snippets"] = "survey"
    input_dir: Path = Path("incoming")
    quarantine_dir: Path | None = None
    poll_s: Annotated[float, Field(gt=0, le=3600)] = 1.0
    settle_s: Annotated[float, Field(ge=0, le=3600)] = 3.0
    require_done_marker: bool = False
    confidence_threshold: Annotated[float, Field(ge=0, le=2)] = 0.3
    max_contacts: Annotated[int, Field(ge=0)] = 0
    max_in_flight: Annotated[int, Field(ge=0, le=100_000)] = 32
    detector: DetectorTuning = DetectorTuning()
    join_overlap_pings: Annotated[int, Field(ge=0, le=900)] = 200
    join_timeout_s: Annotated[float, Field(ge=0, le=86400)] = 0.0
    mask_transmissions: bool = True
    mask_before_s: Annotated[float, Field(ge=0, le=60)] = MARGIN_BEFORE_S
    mask_after_s: Annotated[float, Field(ge=0, le=60)] = MARGIN_AFTER_S
    transmissions_file: Path | None = None
    snippet_height_px: SnippetSidePx = 80
    snippet_width_px: SnippetSidePx = 140
    snippet_pixel_m: Annotated[float, Field(ge=0, le=10)] = 0.0
    fit: Fit = "resize"
    snippet_dir: Path | None = None
    survey_options: Path | None = None
    max_bytes: MaxBytes = 100_000_000_000

    def detector_settings(self) -> DetectorSettings:
        """Return all settings of the detector."""
        return DetectorSettings(
            **self.detector.model_dump(),
            confidence_threshold=self.confidence_threshold,
            max_contacts=self.max_contacts or None,
            join_overlap_pings=self.join_overlap_pings,
        )

    @model_validator(mode="before")
    @classmethod
    def _read_survey_options(cls, table: Any) -> Any:  # noqa: ANN401 - the table before its validation
        """Add the keys of the file `survey_options` to the table.

        Raises:
            ConfigError: The file is invalid, or the table has a key that belongs into the file.
        """
        path = table.get("survey_options") if isinstance(table, dict) else None
        if not isinstance(path, (str, Path)):
            return table
        both = sorted((SurveyOptions.model_fields.keys() & table.keys()) - {"projected_crs"})
        if both:
            raise ConfigError("atd_stub", ", ".join(both), "keys beside survey_options", f"them in {path} only")
        return load_options(Path(path)).model_dump(mode="json", exclude_unset=True) | table
