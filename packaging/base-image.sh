#!/usr/bin/env bash
# Makes sure that the base image of the Dockerfile is at hand: as it is, from a registry or, where none is reached, from
# Debian's own packages with debootstrap, under the very name that the Dockerfile says.
#
#   packaging/base-image.sh [IMAGE]     INSTALL=yes installs debootstrap without asking, if it is needed
set -euo pipefail
cd "$(dirname "$0")/.."
. packaging/progress.sh

image=${1:-$(sed -n 's/^ARG BASE=//p' Dockerfile)}
# debian:13.7-slim, debian:trixie-slim, debian:12-slim
version=${image#*:}
case $version in
    13* | trixie*) suite=trixie ;;
    12* | bookworm*) suite=bookworm ;;
    *) suite= ;;
esac

if docker image inspect "$image" >/dev/null 2>&1; then
    echo "base image: $image is here already"
    exit 0
fi
if FAILURE_LINES=1 progress "base image" timeout "${SONARPOST_PULL_S:-60}" docker pull "$image"; then
    echo "base image: $image pulled"
    exit 0
fi
if [ -z "$suite" ]; then
    echo "base image: got $image, which no registry gives, expected debian:13*, debian:12*, debian:trixie* or debian:bookworm*" >&2
    exit 1
fi

if [ "$(id -u)" != 0 ]; then
    echo "base image: user: got $(id -un), expected root, which debootstrap needs: sudo make images" >&2
    exit 2
fi
if ! command -v debootstrap >/dev/null; then
    command="apt-get update && apt-get install -y --no-install-recommends debootstrap"
    answer=${INSTALL:-}
    if [ -z "$answer" ] && [ -t 0 ]; then
        read -r -p "base image: debootstrap is not installed on this host. Run '$command'? [y/N] " answer || answer=
    fi
    case $answer in
        y | Y | yes) progress "base image" sh -c "$command" ;;
        *)
            echo "base image: debootstrap: got no such program, expected it on this host: run '$command'," \
                "or 'make images INSTALL=yes'" >&2
            exit 2
            ;;
    esac
fi
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
mirror=${SONARPOST_DEBIAN_MIRROR:-http://deb.debian.org/debian}
echo "base image: no registry gives $image, making it from $mirror ($suite)"
progress "base image" debootstrap --variant=minbase --include=ca-certificates "$suite" "$root" "$mirror"
found=$(cat "$root/etc/debian_version")
case $version in
    "$found" | "$found"-* | trixie* | bookworm* | 12-* | 13-*) ;;
    *) echo "base image: WARNING: $image was asked for, and Debian is at $found" >&2 ;;
esac

cat >"$root/etc/apt/sources.list.d/debian.sources" <<SOURCES
Types: deb
URIs: $mirror
Suites: $suite $suite-updates
Components: main
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg

Types: deb
URIs: ${mirror%/debian}/debian-security
Suites: $suite-security
Components: main
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg
SOURCES
rm -f "$root/etc/apt/sources.list" "$root"/var/cache/apt/archives/*.deb "$root"/var/cache/apt/*.bin
find "$root/var/lib/apt/lists" -type f -delete
# As in Debian's own slim images: no manuals, no translations, now or with packages that come later.
cat >"$root/etc/dpkg/dpkg.cfg.d/slim" <<'DPKG'
path-exclude /usr/share/doc/*
path-include /usr/share/doc/*/copyright
path-exclude /usr/share/man/*
path-exclude /usr/share/info/*
path-exclude /usr/share/locale/*
DPKG
find "$root/usr/share/doc" -type f ! -name copyright -delete
rm -rf "$root"/usr/share/man/* "$root"/usr/share/info/* "$root"/usr/share/locale/* "$root"/var/log/*.log "$root"/dev/*
import_base() {
    tar -C "$root" --numeric-owner -c . | docker import --change 'CMD ["bash"]' --message "debootstrap $suite $found" - "$image"
}
progress "base image" import_base
echo "base image: $image made"
