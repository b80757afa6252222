#!/usr/bin/env bash
# Builds the images that docker-compose.yml names. Where no registry is reached, the base is made from Debian's packages
# and the router's image from sonarpost's own router, under the name that the compose file asks for.
#
#   packaging/images.sh          SONARPOST_IMAGE, ROUTER_IMAGE and SONARPOST_BASE override the names
set -euo pipefail
cd "$(dirname "$0")/.."

# What the compose file falls back to: ${NAME:-default}.
default() { sed -n "s/.*\${$1:-\([^}]*\)}.*/\1/p" docker-compose.yml | head -1; }

image=${SONARPOST_IMAGE:-$(default SONARPOST_IMAGE)}
router=${ROUTER_IMAGE:-$(default ROUTER_IMAGE)}
base=${SONARPOST_BASE:-$(default SONARPOST_BASE)}
stand_in=org.sonarpost.stand-in

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

build() { docker build --quiet --build-arg "BASE=$base" "$@" . 2>&1 | grep -v -e DEPRECATED -e 'Install the buildx' -e docs.docker.com -e '^$' || true; }

SECONDS=0
build --tag "$image"
docker image inspect "$image" >/dev/null
echo "images: $image, $(docker image inspect --format '{{.Size}}' "$image" | awk '{printf "%.0f MB", $1 / 1e6}'), ${SECONDS} s"

ours() { [ "$(docker image inspect --format "{{index .Config.Labels \"$stand_in\"}}" "$router" 2>/dev/null)" = router ]; }
if ! ours; then
    if docker image inspect "$router" >/dev/null 2>&1 || timeout "${SONARPOST_PULL_S:-60}" docker pull --quiet "$router" 2>/dev/null; then
        echo "images: $router as its makers built it"
        exit 0
    fi
fi
build --target router --label "$stand_in=router" --tag "$router"
ours
echo "images: $router is sonarpost's own router, as no registry gives the other"
