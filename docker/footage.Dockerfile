# Films the training and test footage: the games, a screen that nobody sees, and gamesr-footage.
#   docker build -f docker/footage.Dockerfile -t gamesr-footage .
#   docker run --rm -v "$PWD/footage:/footage" gamesr-footage render /footage
FROM debian:bookworm-slim

# The games lie in /usr/games. The C compiler builds the frame clock that is preloaded into them.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
        openarena supertuxkart xvfb libgl1-mesa-dri gcc libc6-dev python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*

COPY . /src
RUN python3 -m venv /opt/gamesr \
    && /opt/gamesr/bin/pip install --no-cache-dir -c /src/constraints.txt '/src[footage]' \
    && rm -rf /src

RUN useradd --create-home --uid 1000 gamesr && mkdir /footage && chown gamesr /footage
USER gamesr
VOLUME /footage
ENTRYPOINT ["/opt/gamesr/bin/gamesr-footage"]
CMD ["list"]
