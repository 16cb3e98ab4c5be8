# A service of maps: docker build -t topoloc . (see docs/service.md). Runs as nobody, on a read-only file system.
FROM python:3.12-slim AS build
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY src src
RUN python -m venv /opt/topoloc \
 && /opt/topoloc/bin/pip install --no-cache-dir --constraint constraints.txt .

FROM python:3.12-slim
COPY --from=build /opt/topoloc /opt/topoloc
ENV PATH=/opt/topoloc/bin:$PATH PYTHONDONTWRITEBYTECODE=1 NUMBA_CACHE_DIR=/opt/kernels
# The kernels' machine code, made here once and read-only afterwards; the code is that of the processor that builds.
RUN python -c "import topoloc; topoloc.warm_up()"
USER 65534:65534
EXPOSE 8571
ENTRYPOINT ["topoloc", "serve"]
CMD ["/maps", "--host", "0.0.0.0", "--behind-proxy", "--token-file", "/run/token"]
