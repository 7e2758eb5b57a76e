# The grasp service: weights inside, nothing to download at start.
#
#   docker build -t tes-net --build-arg TORCH_INDEX_URL=https://download.pytorch.org/whl/cpu .
#   docker run --rm -p 8000:8000 --read-only --tmpfs /tmp tes-net
#
# BASE_IMAGE       any Debian-like image with python3 (3.10 or later) and its venv module
# TORCH_INDEX_URL  index for PyTorch alone; without it the default index answers, whose Linux wheels carry CUDA
ARG BASE_IMAGE=python:3.11-slim

FROM ${BASE_IMAGE} AS build
ARG TORCH_INDEX_URL=""
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
# An environment of its own: Debian's python3 refuses packages from outside, and the next stage copies one folder.
RUN python3 -m venv /opt/tesnet
# PyTorch first and alone, so that this large layer stays when the code changes.
WORKDIR /build
COPY constraints.txt ./
RUN /opt/tesnet/bin/pip install --constraint constraints.txt --no-deps \
    ${TORCH_INDEX_URL:+--index-url "${TORCH_INDEX_URL}"} torch
COPY pyproject.toml README.md LICENSE ./
COPY tesnet/ tesnet/
COPY service/ service/
COPY client/ client/
COPY weights/ weights/
RUN /opt/tesnet/bin/pip install --constraint constraints.txt ".[service]"

FROM ${BASE_IMAGE}
COPY --from=build /opt/tesnet /opt/tesnet
RUN useradd --system --uid 10001 --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin grasp
# Nothing is written at run time: the root file system may be mounted read-only.
ENV PATH=/opt/tesnet/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    GRASP_HOST=0.0.0.0 \
    GRASP_PORT=8000
# A number, so that an orchestrator can see that it is not root.
USER 10001
WORKDIR /opt/tesnet
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=5s --start-period=30s --retries=3 \
    CMD ["python", "-c", "import http.client, os, sys; c = http.client.HTTPConnection('127.0.0.1', int(os.environ['GRASP_PORT']), timeout=4); c.request('GET', '/health/ready'); sys.exit(c.getresponse().status != 200)"]
CMD ["python", "-m", "service"]
