# sonarpost: one image for every service, and one for the embedded router.
#
#   docker build -t sonarpost:dev .                       every service: command = a service's name
#   docker build -t sonarpost-router:dev --target router .  instead of eclipse/zenoh where no registry is reached
#
# Works with BuildKit and with the builder before it. `make images` builds both, and the base too where no registry is
# reached.
ARG BASE=debian:13.7-slim

# What every stage has: Debian's own Python, so that the virtual environment fits wherever it is copied.
FROM ${BASE} AS python
RUN apt-get update -q \
    && apt-get install -q -y --no-install-recommends python3 \
    && apt-get clean \
    && rm -rf /usr/lib/python3*/test /var/lib/apt/lists/* /var/cache/debconf/*-old /var/log/apt /var/log/dpkg.log /var/log/alternatives.log

# Everything that is downloaded, and a C compiler.
FROM python AS dependencies
RUN apt-get update -q \
    && apt-get install -q -y --no-install-recommends python3-venv python3-dev python3-setuptools g++ libc6-dev \
        ca-certificates \
    && rm -rf /var/lib/apt/lists/*
# An index of one's own, or none at all with wheels in packaging/wheels; the certificate of a proxy in packaging/ca.
ARG PIP_INDEX_URL
ARG PIP_NO_INDEX
ENV PIP_CERT=/etc/ssl/certs/ca-certificates.crt PIP_FIND_LINKS=/src/packaging/wheels PIP_DISABLE_PIP_VERSION_CHECK=1 \
    PIP_NO_CACHE_DIR=1 PIP_NO_COMPILE=1
COPY packaging/ca/ /usr/local/share/ca-certificates/
COPY packaging/wheels/ /src/packaging/wheels/
COPY requirements.lock requirements-build.lock /src/
RUN update-ca-certificates \
    && python3 -m venv /opt/build \
    && /opt/build/bin/pip install --require-hashes -r /src/requirements-build.lock \
    && python3 -m venv /opt/sonarpost \
    && /opt/sonarpost/bin/pip install --only-binary :all: --require-hashes -r /src/requirements.lock \
    && echo /opt/app > "$(echo /opt/sonarpost/lib/python3*/site-packages)/sonarpost-app.pth"

# What services need of it. A release of sonarpost that needs nothing new leaves this layer as it is. Byte code is never
# checked against the source: the root file system may be read-only, and dates may change on the way through layers.
FROM dependencies AS trimmed
COPY packaging/trim.sh /src/packaging/
RUN sh /src/packaging/trim.sh /opt/sonarpost --without-numba \
    && python3 -m compileall -q --invalidation-mode unchecked-hash /opt/sonarpost/lib

FROM dependencies AS build
COPY pyproject.toml README.md LICENSE NOTICE /src/
COPY packaging/compile_codecs.py packaging/check_image.py /src/packaging/
COPY common/ /src/common/
COPY services/ /src/services/
COPY config/ /src/config/
# numba compiles the codecs' functions here, for any processor of this architecture. The image has neither numba nor its
# compiler LLVM.
RUN cd /src && /opt/build/bin/python -m build --wheel --no-isolation --outdir /dist . \
    && /opt/build/bin/pip --python /opt/sonarpost/bin/python install --no-deps --no-index --target /opt/app /dist/*.whl \
    && export NUMBA_CPU_NAME=generic \
    && PYTHONPATH=/usr/lib/python3/dist-packages /opt/sonarpost/bin/python -B packaging/compile_codecs.py \
    && NUMBA_CACHE_DIR=/tmp/machine-code /opt/sonarpost/bin/python -B packaging/check_image.py > /dist/with-numba \
    && python3 -m compileall -q --invalidation-mode unchecked-hash /opt/app

FROM trimmed AS checked
COPY packaging/check_image.py /src/packaging/
COPY --from=build /dist/with-numba /dist/
COPY --from=build /opt/app /opt/app
RUN /opt/sonarpost/bin/python -B /src/packaging/check_image.py | cmp - /dist/with-numba

FROM python AS runtime
ENV PATH=/opt/app/bin:/opt/sonarpost/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    SONARPOST_HEARTBEAT=/tmp/heartbeat.json
RUN groupadd --gid 10001 sonarpost \
    && useradd --uid 10001 --gid 10001 --no-create-home --home-dir /var/lib/sonarpost --shell /usr/sbin/nologin sonarpost \
    && install -d -o sonarpost -g sonarpost /var/lib/sonarpost /var/lib/sonarpost/incoming \
    && install -d -m 0700 -o sonarpost -g sonarpost /var/lib/sonarpost/state /var/lib/sonarpost/images \
        /var/lib/sonarpost/pki /var/lib/sonarpost/tls \
        /var/lib/sonarpost/tls/shore /var/lib/sonarpost/tls/vessel \
        /var/lib/sonarpost/acoustic /var/lib/sonarpost/acoustic/uuv /var/lib/sonarpost/acoustic/vessel
COPY --from=trimmed /opt/sonarpost /opt/sonarpost
COPY packaging/bin/ /usr/local/bin/
COPY config/ /etc/sonarpost/
COPY --from=checked /opt/app /opt/app
USER 10001:10001
WORKDIR /var/lib/sonarpost
ENTRYPOINT ["sonarpost-entrypoint"]
CMD ["sonarpost", "--help"]
HEALTHCHECK --interval=10s --timeout=5s --start-period=40s --retries=3 \
    CMD ["python", "-m", "sonarpost.monitoring.healthcheck"]

FROM runtime AS router
ENTRYPOINT ["python", "-m", "sonarpost.bus.router"]
CMD ["--listen", "tcp/0.0.0.0:7447"]
HEALTHCHECK NONE

# The last stage is what `docker build` makes when it is not told which.
FROM runtime
