"""Preparation of machine code, and the message when a codec compiles in a running process."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from builders.common import GOLDEN_FOLDER
from builders.images import snippet

from sonarpost.sonar.image_files import write_png

MESSAGE = "Preparing machine code for the {codec} codec: about {seconds} s, once for each installation"
ENCODE_AND_DECODE = """
import logging, sys
import numpy as np
logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s %(message)s", stream=sys.stdout)
import sonarpost.codec as c
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.emb.side_info import RegionOfInterest
from sonarpost.codec.jit import compilation_log
image = np.random.default_rng(0).integers(0, 256, (75, 48), dtype=np.uint8)
for model in ("standard", "structure"):
    codec = EmbCodec(model)
    header, best = codec.best_trial(image, 90, region=RegionOfInterest(2, 2, 7, 7), texture=(1,) * 8)
    stream = header.pack() + best.body
    codec.extend(stream, image, 150)
    codec.decode(stream[:20])
    c.decode(c.encode(image.astype(np.uint16) * 257, model=model))
c.decode(c.encode(image, "vq"))
c.decode(c.encode(image, "vq", codebook="nominal-20"))
print("compiled", compilation_log.compiled)
"""
DECODE_TWICE = """
import json, logging, sys
from pathlib import Path
logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s %(message)s", stream=sys.stdout)
import sonarpost.codec as c
golden = json.loads(Path("GOLDEN").read_text())
for case in ("80x80 at 64 B", "17x33 at 40 B"):
    c.decode(bytes.fromhex(golden[case]["stream"]))
""".replace("GOLDEN", str(GOLDEN_FOLDER / "emb" / "streams.json"))


def run(cache: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, check=True)


@pytest.mark.system
def test_first_use_prints_the_message_once_and_prepare_completes_the_cache(tmp_path: Path) -> None:
    cache, images = tmp_path / "cache", tmp_path / "images"
    images.mkdir()
    for name in ("a", "b"):
        write_png(images / f"{name}.png", snippet(32, 48))
    encode = ("-m", "sonarpost.cli.main", "encode", str(images))
    first = run(cache, *encode)
    # Progress, on a slow host, is not of interest here.
    lines = [line for line in first.stderr.splitlines() if not line.startswith("encoding: ")]
    assert lines == [MESSAGE.format(codec="emb", seconds=10)]
    assert "2 of 2 files done" in first.stdout
    assert run(cache, *encode).stderr == ""
    message = MESSAGE.format(codec="emb", seconds=10)
    assert run(cache, "-c", DECODE_TWICE).stdout == f"WARNING sonarpost.codec.jit {message}\n"
    preparing = run(cache, "-m", "sonarpost.cli.main", "prepare")
    assert preparing.stderr.splitlines()[0] == "Preparing machine code: emb, model standard"
    prepared = preparing.stdout
    assert prepared.startswith("Machine code is ready: compiled=")
    assert str(cache) in prepared
    # One specialisation of each function: more of them multiply the compile time.
    specialisations = Counter(path.name.rsplit(".", 2)[0] for path in cache.glob("emb_*/*.nbc"))
    assert [name for name, count in specialisations.items() if count > 1] == []
    assert len(specialisations) in range(15, 21)
    again = run(cache, "-m", "sonarpost.cli.main", "prepare", "-q")
    assert (again.stdout, again.stderr) == ("Machine code is ready: nothing to compile\n", "")
    # Encoding and decoding in another process, with all options, compiles nothing and logs nothing.
    assert run(cache, "-c", ENCODE_AND_DECODE).stdout.splitlines() == ["compiled 0"]
