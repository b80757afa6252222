#!/usr/bin/env bash
# Builds the image of the services and gets that of the router. Where no registry is reached, the base is made from
# Debian's packages, and the router's image is built from sonarpost's own router under a name of its own, sonarpost-router.
# build/router-image holds the name of the router's image, for ROUTER_IMAGE in .env.
#
#   packaging/images.sh          SONARPOST_IMAGE, ROUTER_IMAGE and SONARPOST_BASE override the names;
#                                INSTALL=yes installs debootstrap without asking, if it is needed
set -euo pipefail
cd "$(dirname "$0")/.."
. packaging/progress.sh

# What the compose file falls back to: ${NAME:-default}.
default() { sed -n "s/.*\${$1:-\([^}]*\)}.*/\1/p" docker-compose.yml | head -1; }

image=${SONARPOST_IMAGE:-$(default SONARPOST_IMAGE)}
router=${ROUTER_IMAGE:-$(default ROUTER_IMAGE)}
base=${SONARPOST_BASE:-$(default SONARPOST_BASE)}
own_router=sonarpost-router:${image##*:}

if ! command -v docker >/dev/null; then
    echo "images: docker: got no such program, expected Docker; on Debian: apt-get install docker.io docker-compose" >&2
    exit 2
fi
if ! docker info >/dev/null 2>&1; then
    echo "images: no container engine answers (docker info)" >&2
    exit 3
fi
packaging/base-image.sh "$base"

# Behind a proxy that opens TLS connections pip needs its certificate, which this host trusts already.
certificates=${PIP_CERT:-${SSL_CERT_FILE:-}}
borrowed=
if [ -n "$certificates" ] && [ -r "$certificates" ] && ! ls packaging/ca/*.crt >/dev/null 2>&1; then
    borrowed=packaging/ca/host.crt
    trap 'rm -f "$borrowed"' EXIT
    install -m 0644 "$certificates" "$borrowed"
fi

build() { progress images docker build --build-arg "BASE=$base" "$@" .; }

SECONDS=0
build --tag "$image"
docker image inspect "$image" >/dev/null
echo "images: $image, $(docker image inspect --format '{{.Size}}' "$image" | awk '{printf "%.0f MB", $1 / 1e6}'), ${SECONDS} s"

chosen() { mkdir -p build && echo "$1" > build/router-image; }
if [ "${router%%:*}" != sonarpost-router ]; then
    if docker image inspect "$router" >/dev/null 2>&1 || FAILURE_LINES=1 progress images timeout "${SONARPOST_PULL_S:-60}" docker pull "$router"; then
        chosen "$router"
        echo "images: $router"
        exit 0
    fi
    echo "images: no registry has $router: building $own_router"
    router=$own_router
fi
build --target router --tag "$router"
docker image inspect "$router" >/dev/null
chosen "$router"
echo "images: $router"
if [ "$router" != "$(default ROUTER_IMAGE)" ] && [ -z "${ROUTER_IMAGE:-}" ]; then
    echo "images: before docker-compose, add this line to .env: ROUTER_IMAGE=$router"
fi
