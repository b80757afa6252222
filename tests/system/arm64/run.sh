#!/usr/bin/env bash
# Run on an emulated aarch64: `encode` and `decode`, compared with the same commands here; the modem driver against the
# modem emulator; the golden tests of every codec.
#
#     tests/system/arm64/run.sh [pytest arguments]        with arguments: only these tests
#
# Needs Debian's or Ubuntu's apt (nothing is installed, root is not needed), qemu-aarch64-static (package
# qemu-user-static), and about 1 GB below build/arm64. Fetches arm64 Debian packages of the system's own Python, which
# must be 3.11 or later, and aarch64 wheels of the locked versions from PyPI; a second run fetches nothing. Twelve
# minutes on a shared core, half of them for the tests of the driver.
set -euo pipefail
cd "$(dirname "$0")/../../.."

work=$PWD/build/arm64
python_package=${ARM64_PYTHON:-python3.11}
version=${python_package#python}
qemu=$(command -v qemu-aarch64-static) || { echo "run.sh: qemu-aarch64-static is absent: apt-get install qemu-user-static" >&2; exit 2; }
pip=(.venv/bin/python -m pip)

if [ ! -e "$work/root/.ready" ]; then
    rm -rf "$work/root" "$work/apt"
    mkdir -p "$work"/root "$work"/apt/{state/lists/partial,cache/archives/partial}
    touch "$work/apt/status"
    cat > "$work/apt.conf" <<CONF
Dir::State "$work/apt/state";
Dir::State::status "$work/apt/status";
Dir::Cache "$work/apt/cache";
APT::Architecture "arm64";
APT::Architectures { "arm64"; };
APT::Sandbox::User "";
CONF
    export APT_CONFIG=$work/apt.conf
    apt-get update -q
    apt-get install -q -y --no-install-recommends --download-only "$python_package" libstdc++6 libgomp1 zlib1g
    unset APT_CONFIG
    for package in "$work"/apt/cache/archives/*.deb; do
        dpkg -x "$package" "$work/root"
    done
    touch "$work/root/.ready"
fi

# What the tests below import: the locked versions.
names='numpy|scipy|numba|llvmlite|pillow|pillow-jxl-plugin|pydantic|pydantic-core|annotated-types|typing-inspection'
names+='|typing-extensions|msgpack|tifffile|pytest|pytest-timeout|iniconfig|pluggy|packaging|pygments|hypothesis|sortedcontainers'
names+='|rich|markdown-it-py|mdurl|pyserial|eclipse-zenoh'
if ! grep -ioE "^($names)==[^ ]+" requirements-dev.lock | cmp -s - "$work/site/.wanted"; then
    rm -rf "$work/site"
    platforms=()
    for glibc in 2_36 2_34 2_31 2_28 2_27 2_26 2_24 2_17; do
        platforms+=(--platform "manylinux_${glibc}_aarch64")
    done
    grep -ioE "^($names)==[^ ]+" requirements-dev.lock > "$work/wanted"
    "${pip[@]}" install --quiet --disable-pip-version-check --target "$work/site" --no-deps --only-binary=:all: \
        "${platforms[@]}" --platform manylinux2014_aarch64 --implementation cp --python-version "$version" -r "$work/wanted"
    mv "$work/wanted" "$work/site/.wanted"
fi

export PYTHONPATH=$work/site:$PWD/common:$PWD/tests NUMBA_CACHE_DIR=$work/numba PYTHONDONTWRITEBYTECODE=1
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
python=("$qemu" -L "$work/root" "$work/root/usr/bin/$python_package")
"${python[@]}" -c 'import platform, sys; print(platform.machine(), sys.version); sys.exit(platform.machine() != "aarch64")'
pytest=("${python[@]}" -m pytest --noconftest -p no:cacheprovider -q -o timeout=3000 --hypothesis-profile ci)
if [ $# -gt 0 ]; then
    exec "${pytest[@]}" "$@"
fi

# The commands: the same streams and the same pixels as on this machine.
rm -rf "$work/images" && mkdir -p "$work/images"
here=(env -u PYTHONPATH .venv/bin/python)
"${here[@]}" - "$work/images/contact.png" <<'PYTHON'
import sys
from pathlib import Path

import numpy as np

from sonarpost.sonar.image_files import write_png

image = np.random.default_rng(1).gamma(4.0, 25.0, size=(80, 140))
image[30:36, 60:70] *= 3
image[30:36, 70:100] *= 0.1
write_png(Path(sys.argv[1]), np.clip(image, 0, 255).astype(np.uint8))
PYTHON
for where in here there; do
    command=("${python[@]}")
    [ $where = there ] || command=("${here[@]}")
    for codec in emb vq; do
        "${command[@]}" -m sonarpost.cli.main encode "$work/images/contact.png" --codec $codec --out "$work/images/$where"
        "${command[@]}" -m sonarpost.cli.main decode "$work/images/$where/contact.$codec" --out "$work/images/$where/$codec"
    done
done
diff -r "$work/images/here" "$work/images/there"
echo "encode and decode: the same files as on $(uname -m)"

# The driver, without ports and on pseudo-terminals.
"${pytest[@]}" tests/modem tests/extensions/simulation/modem/test_emulator.py tests/runtime/test_serial_modem.py
# The test left out starts a Python of its own, which the emulator does not see.
"${pytest[@]}" -k "golden and not generic_processor" tests/codec tests/research/baselines
