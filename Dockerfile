# The service in a slim image: built in one stage, run in another as a user without rights, CPU only.
#
#   docker build -t thermal-twin .
#   docker run -p 8000:8000 -v twin-data:/data -e TWIN_API_KEYS=operate:CHOOSE-A-KEY thermal-twin

FROM python:3.11-slim AS build
# Where the CPU build of torch comes from; the default index would bring gigabytes of CUDA libraries along.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
RUN python -m venv /opt/twin
ENV PATH=/opt/twin/bin:$PATH
RUN pip install --index-url "$TORCH_INDEX" --extra-index-url https://pypi.org/simple torch==2.13.0
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY twin_core twin_core
COPY thermal_twin thermal_twin
COPY service service
COPY replay replay
RUN pip install ".[neural,postgres,dask]" && python -m compileall -q /opt/twin

FROM python:3.11-slim
RUN useradd --system --uid 10001 --home-dir /data --shell /usr/sbin/nologin twin \
 && install -d -o twin -g twin /data /var/cache/numba
COPY --from=build /opt/twin /opt/twin
ENV PATH=/opt/twin/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/var/cache/numba \
    OMP_NUM_THREADS=1 \
    TWIN_HOST=0.0.0.0 \
    TWIN_PORT=8000 \
    TWIN_DATABASE_URL=sqlite:////data/twin.sqlite3
USER twin
RUN python -m twin_core.compiled
WORKDIR /data
VOLUME /data
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=30s --timeout=5s --start-period=20s --retries=3 \
    CMD ["python", "-c", "import os, urllib.request as r; r.urlopen(f'http://127.0.0.1:{os.environ[\"TWIN_PORT\"]}/readyz', timeout=4)"]
# Without TWIN_API_KEYS the service refuses to listen on anything but loopback, and says so.
ENTRYPOINT ["python", "-m", "service"]
