#!/bin/sh
# Takes out of a virtual environment what no service uses: the packages' own tests, what one compiles against, type
# stubs, pip. Debug symbols are stripped from the two largest libraries only: those that auditwheel has patched may not
# survive it.
set -eu
environment=$1
packages=$(echo "$environment"/lib/python3*/site-packages)

find "$packages/numba" "$packages/llvmlite" "$packages/scipy" "$packages/numpy" -depth -type d -name tests -exec rm -r {} +
find "$packages" -depth -type d -name __pycache__ -exec rm -r {} +
find "$packages" -type f \( -name '*.pyi' -o -name '*.pxd' -o -name '*.pyx' -o -name '*.h' -o -name '*.a' -o -name '*.lib' \) -delete
strip --strip-unneeded "$packages"/llvmlite/binding/libllvmlite.so "$packages"/zenoh/zenoh.abi3.so
# Of SciPy, the services use ndimage and fft, which import special. packaging/warm.py imports every module afterwards.
for part in cluster constants datasets differentiate fftpack integrate interpolate io linalg misc odr optimize signal sparse \
    spatial stats; do
    rm -rf "$packages/scipy/$part"
done
rm -rf "$packages"/pip "$packages"/pip-*.dist-info "$environment"/bin/pip* "$environment"/include
