# The workshop: training, export, verification and evaluation. The torch of PyPI brings CUDA, some gigabytes.
#
#   docker build --file docker/train.Dockerfile --tag gamesr-train .
#   docker run --rm --gpus all --shm-size 2g --user "$(id -u):$(id -g)" --volume "$PWD:/work" gamesr-train gamesr-train FOOTAGE.toml RUN
FROM python:3.11-slim-bookworm AS build
WORKDIR /gamesr
RUN python -m venv /opt/gamesr
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY client client
COPY model model
COPY server server
RUN /opt/gamesr/bin/pip install --no-cache-dir -c constraints.txt '.[cpu,metrics,train]'

FROM python:3.11-slim-bookworm
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin gamesr
COPY --from=build /opt/gamesr /opt/gamesr
ENV PATH=/opt/gamesr/bin:$PATH PYTHONUNBUFFERED=1
USER 10001
WORKDIR /work
CMD ["gamesr-train", "--help"]
