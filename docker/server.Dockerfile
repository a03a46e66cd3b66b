# The service, the runner of its sweeps, gamesr-sweep, and Dask for sweeps on several machines; no torch. compose.yaml starts them.
FROM python:3.11-slim-bookworm AS build
WORKDIR /gamesr
RUN python -m venv /opt/gamesr
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY client client
COPY model model
COPY server server
RUN /opt/gamesr/bin/pip install --no-cache-dir -c constraints.txt '.[cpu,serve,dask]'

FROM python:3.11-slim-bookworm
# The store's folder belongs to the user before a volume is mounted over it: a new volume takes that over.
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin gamesr && install --directory --owner gamesr /data
COPY --from=build /opt/gamesr /opt/gamesr
# The root is read-only: what has to be written somewhere goes to /tmp.
ENV PATH=/opt/gamesr/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 MPLCONFIGDIR=/tmp/matplotlib
USER 10001
WORKDIR /data
EXPOSE 8060
CMD ["gamesr-serve", "--help"]
