#!/bin/sh
# Takes out of a virtual environment what no service uses: the packages' own tests, what one compiles against, type
# stubs, pip. Debug symbols are stripped from the largest libraries only: those that auditwheel has patched may not
# survive it.
#
#   trim.sh ENVIRONMENT [--without-numba]    without numba and its compiler, after packaging/compile_codecs.py
set -eu
environment=$1
packages=$(echo "$environment"/lib/python3*/site-packages)

if [ "${2:-}" = --without-numba ]; then
    rm -r "$packages"/numba "$packages"/llvmlite "$packages"/numba-*.dist-info "$packages"/llvmlite-*.dist-info
else
    find "$packages/numba" "$packages/llvmlite" -depth -type d -name tests -exec rm -r {} +
    strip --strip-unneeded "$packages"/llvmlite/binding/libllvmlite.so
fi
find "$packages/scipy" "$packages/numpy" -depth -type d -name tests -exec rm -r {} +
find "$packages" -depth -type d -name __pycache__ -exec rm -r {} +
find "$packages" -type f \( -name '*.pyi' -o -name '*.pxd' -o -name '*.pyx' -o -name '*.h' -o -name '*.a' -o -name '*.lib' \) -delete
strip --strip-unneeded "$packages"/zenoh/zenoh.abi3.so
# Of SciPy, the services use ndimage and fft, which import special. packaging/check_image.py imports every module afterwards.
for part in cluster constants datasets differentiate fftpack integrate interpolate io linalg misc odr optimize signal sparse \
    spatial stats; do
    rm -rf "$packages/scipy/$part"
done
# Libraries that only the removed parts of SciPy used, and then those that only these libraries used.
for _ in 1 2; do
    for library in "$packages"/scipy.libs/*; do
        name=$(basename "$library")
        grep -rqF --include='*.so*' --exclude="$name" "$name" "$packages/scipy" "$packages/scipy.libs" || rm "$library"
    done
done
# Rich needs pygments and markdown-it for source code and Markdown, Pillow libavif for AVIF files.
rm -rf "$packages"/pygments* "$packages"/markdown_it* "$packages"/mdurl* "$packages"/PIL/_avif.* "$packages"/pillow.libs/libavif*
rm -rf "$packages"/pip "$packages"/pip-*.dist-info "$environment"/bin/pip* "$environment"/include
