#!/usr/bin/env bash
# Builds the images, runs the whole chain in containers, tests it, and takes everything away again.
#
#   packaging/test-compose.sh [PYTEST ARGUMENT...]     PYTHON names the interpreter that has pytest; INSTALL=yes as in
#                                                      packaging/images.sh
set -euo pipefail
cd "$(dirname "$0")/.."

python=${PYTHON:-.venv/bin/python}
SECONDS=0
export SONARPOST_IMAGE=${SONARPOST_IMAGE:-sonarpost:compose-test}
packaging/images.sh
ROUTER_IMAGE=$(cat build/router-image)
export ROUTER_IMAGE
echo "test-compose: images after ${SECONDS} s"

export SONARPOST_COMPOSE_PROJECT=sonarpost-test-$$
# The tests clear up; this is for when they are killed.
clear_up() {
    docker ps -aq --filter "label=com.docker.compose.project=$SONARPOST_COMPOSE_PROJECT" | xargs -r docker rm -f >/dev/null
    docker network ls -q --filter "label=com.docker.compose.project=$SONARPOST_COMPOSE_PROJECT" | xargs -r docker network rm >/dev/null
    docker volume ls -q --filter "label=com.docker.compose.project=$SONARPOST_COMPOSE_PROJECT" | xargs -r docker volume rm >/dev/null
    docker image rm "$SONARPOST_IMAGE-next" "$SONARPOST_IMAGE-systemd" >/dev/null 2>&1 || true
}
trap clear_up EXIT
status=0
"$python" -m pytest tests/system/compose -m containers -q "$@" || status=$?
echo "test-compose: ${SECONDS} s in all"
docker image ls --format 'test-compose: {{.Repository}}:{{.Tag}} {{.Size}}' "$SONARPOST_IMAGE"
exit "$status"
