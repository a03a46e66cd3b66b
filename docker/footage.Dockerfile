# Films the training and test footage: the games, a screen that nobody sees, and gamesr-footage. See docs/footage.md.
#
#   docker build --file docker/footage.Dockerfile --tag gamesr-footage .
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD/footage:/footage" gamesr-footage gamesr-footage render /footage
FROM python:3.11-slim-bookworm AS build
WORKDIR /gamesr
RUN python -m venv /opt/gamesr
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY client client
COPY model model
COPY server server
RUN /opt/gamesr/bin/pip install --no-cache-dir -c constraints.txt '.[footage]'

FROM python:3.11-slim-bookworm
# The C compiler builds the frame clock that is preloaded into the games. Debian keeps one version of a package in a release: none is pinned.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
        openarena supertuxkart minetest xvfb libgl1-mesa-dri gcc libc6-dev \
    && rm -rf /var/lib/apt/lists/*
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin gamesr && install --directory --owner gamesr /footage
COPY --from=build /opt/gamesr /opt/gamesr
# The frame clock is built where the user of the container may write.
ENV PATH=/opt/gamesr/bin:$PATH PYTHONUNBUFFERED=1 HOME=/tmp
USER 10001
WORKDIR /footage
CMD ["gamesr-footage", "list"]
