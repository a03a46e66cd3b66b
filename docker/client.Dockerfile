# What a player installs: numpy, PyAV and ONNX Runtime, no torch.
#
#   docker build --file docker/client.Dockerfile --tag gamesr-client .
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/videos" gamesr-client match_540p.mp4 -o match_1080p.mp4
FROM python:3.11-slim-bookworm AS build
WORKDIR /gamesr
RUN python -m venv /opt/gamesr
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY client client
COPY model model
COPY server server
RUN /opt/gamesr/bin/pip install --no-cache-dir -c constraints.txt '.[cpu]'

FROM python:3.11-slim-bookworm
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin gamesr
COPY --from=build /opt/gamesr /opt/gamesr
ENV PATH=/opt/gamesr/bin:$PATH PYTHONUNBUFFERED=1
USER 10001
WORKDIR /videos
ENTRYPOINT ["gamesr-upscale"]
CMD ["--help"]
