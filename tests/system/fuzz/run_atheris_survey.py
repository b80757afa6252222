"""Fuzz the survey readers, guided by coverage of the Python code (Atheris, on libFuzzer).

    python -m pip install 'sonarpost[fuzz]'       # x86-64 and Python 3.11 to 3.13: Atheris has no other wheels
    python tests/system/fuzz/run_atheris_survey.py -max_total_time=180
    python tests/system/fuzz/run_atheris_survey.py --formats=jsf -max_total_time=180

Options with one dash are those of libFuzzer; `--formats` limits the run to some formats, separated by commas. The first
byte of an input selects the file (`survey_oracle.FILES`), and the rest is its content. The seeds are valid recordings.
Interesting inputs are stored in `build/fuzz/survey`. An input that fails is written to the current folder;
`run_atheris_survey.py crash-…` with the same formats repeats it.
"""

import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[3]
WORK = ROOT / "build" / "fuzz" / "survey"
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "common")]

try:
    import atheris
except ImportError:
    sys.exit("run_atheris_survey: Atheris is not installed here: python -m pip install 'sonarpost[fuzz]'")

with atheris.instrument_imports(include=["sonarpost.sonar", "fuzz"]):
    from builders.atheris_run import fuzz
    from builders.survey_oracle import Readers

FORMATS = "--formats="


def main() -> None:
    """Run until libFuzzer ends the process."""
    arguments = [argument for argument in sys.argv[1:] if not argument.startswith(FORMATS)]
    formats = [argument.removeprefix(FORMATS) for argument in sys.argv[1:] if argument.startswith(FORMATS)]
    WORK.mkdir(parents=True, exist_ok=True)
    # Not deleted, because libFuzzer ends the process.
    folder = Path(tempfile.mkdtemp(prefix="survey-", dir=WORK.parent))
    readers = Readers(folder, formats[0].split(",")) if formats else Readers(folder)
    fuzz(readers.check, WORK / formats[0] if formats else WORK, readers.seeds, 4096, *arguments)


if __name__ == "__main__":
    main()
