# The decoder as a service: `runtime` without torch, `camera` with the drivers of cameras and of a modulator on a monitor,
# `deep` with torch, to train and export in the device, `gpu` that decodes on an NVIDIA GPU.
#
#   docker build --target runtime -t lightpage:runtime .
#   docker run --read-only --tmpfs /tmp -v bundles:/bundles -v state:/state -p 50051:50051 lightpage:runtime
#
# Two optional build secrets carry the builder's own package settings in without leaving them in a layer:
# `pip_conf` (a pip configuration file) and `ca_bundle` (trusted certificates, where the registry needs its own). A build
# context `packages` takes the place of the empty stage of that name where packages come from a folder.

FROM scratch AS packages

FROM debian:bookworm-slim AS base
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/* /var/log/apt /var/log/dpkg.log
# A fixed number, so that volumes can be given to it beforehand; the service owns its state and nothing else.
RUN groupadd --gid 10001 lightpage \
    && useradd --uid 10001 --gid 10001 --home-dir /state --no-create-home --shell /usr/sbin/nologin lightpage \
    && install -d -o 10001 -g 10001 /bundles /state

FROM base AS build
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3-venv \
    && rm -rf /var/lib/apt/lists/* \
    && python3 -m venv /opt/lightpage
WORKDIR /src
COPY pyproject.toml constraints.txt LICENSE README.md ./
COPY lightpage lightpage
COPY train train
COPY export export
COPY runtime runtime
COPY analysis analysis
RUN --mount=type=secret,id=pip_conf,target=/etc/pip.conf \
    --mount=type=secret,id=ca_bundle,target=/run/secrets/ca_bundle \
    --mount=type=bind,from=packages,target=/run/packages \
    /opt/lightpage/bin/pip install --no-cache-dir --constraint constraints.txt '.[cpu,traces]'

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
    CMD ["python", "-m", "runtime.commands.healthcheck"]
ENTRYPOINT ["lightpage", "serve"]
CMD ["--source", "simulator:bench", "--address", "0.0.0.0:50051"]

FROM service AS runtime
COPY --from=build /opt/lightpage /opt/lightpage

FROM build AS build-camera
RUN --mount=type=secret,id=pip_conf,target=/etc/pip.conf \
    --mount=type=secret,id=ca_bundle,target=/run/secrets/ca_bundle \
    --mount=type=bind,from=packages,target=/run/packages \
    /opt/lightpage/bin/pip install --no-cache-dir --constraint constraints.txt '.[cpu,camera,screen,traces]'

FROM runtime AS camera
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
    /opt/lightpage/bin/pip install --no-cache-dir --constraint constraints.txt '.[cpu,train,traces]'

FROM runtime AS deep
COPY --from=build-deep /opt/lightpage /opt/lightpage

# An environment of its own: onnxruntime-gpu and onnxruntime are one module, and whichever came last would count.
FROM build AS build-gpu
RUN --mount=type=secret,id=pip_conf,target=/etc/pip.conf \
    --mount=type=secret,id=ca_bundle,target=/run/secrets/ca_bundle \
    --mount=type=bind,from=packages,target=/run/packages \
    rm -rf /opt/lightpage \
    && python3 -m venv /opt/lightpage \
    && /opt/lightpage/bin/pip install --no-cache-dir --constraint constraints.txt '.[gpu,traces]'

FROM service AS gpu
COPY --from=build-gpu /opt/lightpage /opt/lightpage
ENV LIGHTPAGE_SERVICE__PROVIDER=cuda

# What a plain `docker build .` makes.
FROM runtime
