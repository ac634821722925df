# The decoder as a service: `runtime` without torch, `camera` with the drivers of cameras and of a modulator on a monitor,
# `deep` with torch, to train and export in the device, `gpu` that decodes on an NVIDIA GPU, `ray` for a cluster of KubeRay.
#
#   docker build --target runtime -t lightpage:runtime .
#   docker run --read-only --tmpfs /tmp -v bundles:/bundles -v state:/state -p 127.0.0.1:50051:50051 \
#       -e LIGHTPAGE_SERVICE__INSECURE=true lightpage:runtime
#
# The build argument `BASE` names the Debian that it is made from; a release names it with its digest. Python packages are
# those of release/locks, each checked by its SHA-256 (docs/reference/supply-chain.md).
#
# Two optional build secrets carry the builder's own package settings in without leaving them in a layer:
# `pip_conf` (a pip configuration file) and `ca_bundle` (trusted certificates, where the registry needs its own). A build
# context `packages` takes the place of the empty stage of that name where packages come from a folder.

ARG BASE=debian:bookworm-slim

FROM scratch AS packages

FROM ${BASE} AS base
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/* /var/log/apt /var/log/dpkg.log
# A fixed number, so that volumes can be given to it beforehand; the service owns its state and nothing else.
RUN groupadd --gid 10001 lightpage \
    && useradd --uid 10001 --gid 10001 --home-dir /state --no-create-home --shell /usr/sbin/nologin lightpage \
    && install -d -o 10001 -g 10001 /bundles /state

# /opt/build has Debian's pip and the tools that make wheels; /opt/lightpage gets what is installed, and neither of them.
# The compiler, too, stays here.
FROM base AS build
ARG SOURCE_DATE_EPOCH
RUN apt-get update \
    && apt-get install -y --no-install-recommends gcc libc6-dev python3-dev python3-venv \
    && rm -rf /var/lib/apt/lists/* \
    && python3 -m venv /opt/build \
    && python3 -m venv --without-pip /opt/lightpage
WORKDIR /src
COPY release release
RUN --mount=type=secret,id=pip_conf,target=/etc/pip.conf \
    --mount=type=secret,id=ca_bundle,target=/run/secrets/ca_bundle \
    --mount=type=bind,from=packages,target=/run/packages \
    /opt/build/bin/pip install --no-cache-dir --require-hashes --only-binary :all: --requirement release/locks/build.txt
COPY pyproject.toml setup.py LICENSE README.md ./
COPY lightpage lightpage
COPY train train
COPY export export
COPY runtime runtime
COPY demo demo
COPY report report
COPY study study
COPY virtual_device virtual_device
RUN LIGHTPAGE_PAGE_CODE=compiled /opt/build/bin/pip wheel --no-deps --no-build-isolation --no-index --wheel-dir /dist .

FROM base AS service
# The root file system is read-only in service: no byte code is written, and what must be written goes to /state or /tmp.
# MPLCONFIGDIR: matplotlib insists on a folder of its own.
ENV PATH=/opt/lightpage/bin:$PATH \
    HOME=/state \
    LIGHTPAGE_STORE=/state/models \
    MPLCONFIGDIR=/tmp/matplotlib \
    ORT_DISABLE_TELEMETRY=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1
USER 10001:10001
WORKDIR /state
VOLUME ["/bundles", "/state"]
EXPOSE 50051 50052
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s --retries=3 \
    CMD ["python", "-m", "lightpage.runtime.commands.service.healthcheck"]
ENTRYPOINT ["lightpage", "serve"]
CMD ["--source", "simulator:bench", "--address", "0.0.0.0:50051"]

FROM build AS build-runtime
RUN --mount=type=secret,id=pip_conf,target=/etc/pip.conf \
    --mount=type=secret,id=ca_bundle,target=/run/secrets/ca_bundle \
    --mount=type=bind,from=packages,target=/run/packages \
    release/install_locked.sh release/locks/runtime.txt /opt/lightpage

FROM service AS runtime
COPY --from=build-runtime /opt/lightpage /opt/lightpage

FROM build AS build-camera
RUN --mount=type=secret,id=pip_conf,target=/etc/pip.conf \
    --mount=type=secret,id=ca_bundle,target=/run/secrets/ca_bundle \
    --mount=type=bind,from=packages,target=/run/packages \
    release/install_locked.sh release/locks/camera.txt /opt/lightpage

FROM service AS camera
USER 0:0
RUN apt-get update \
    && apt-get install -y --no-install-recommends libaravis-0.8-0 libxcb1 \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/* /var/log/apt /var/log/dpkg.log
COPY --from=build-camera /opt/lightpage /opt/lightpage
USER 10001:10001

FROM build AS build-deep
RUN --mount=type=secret,id=pip_conf,target=/etc/pip.conf \
    --mount=type=secret,id=ca_bundle,target=/run/secrets/ca_bundle \
    --mount=type=bind,from=packages,target=/run/packages \
    release/install_locked.sh release/locks/deep.txt /opt/lightpage

FROM service AS deep
COPY --from=build-deep /opt/lightpage /opt/lightpage

FROM build AS build-gpu
RUN --mount=type=secret,id=pip_conf,target=/etc/pip.conf \
    --mount=type=secret,id=ca_bundle,target=/run/secrets/ca_bundle \
    --mount=type=bind,from=packages,target=/run/packages \
    release/install_locked.sh release/locks/gpu.txt /opt/lightpage

FROM service AS gpu
COPY --from=build-gpu /opt/lightpage /opt/lightpage
ENV LIGHTPAGE_SERVICE__PROVIDER=cuda

FROM build AS build-ray
RUN --mount=type=secret,id=pip_conf,target=/etc/pip.conf \
    --mount=type=secret,id=ca_bundle,target=/run/secrets/ca_bundle \
    --mount=type=bind,from=packages,target=/run/packages \
    release/install_locked.sh release/locks/ray.txt /opt/lightpage

FROM service AS ray
COPY --from=build-ray /opt/lightpage /opt/lightpage
ENV RAY_USAGE_STATS_ENABLED=0

# What a plain `docker build .` makes.
FROM runtime
