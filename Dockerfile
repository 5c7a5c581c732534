# Stage 1: the wheel, and a virtual environment with the pinned versions of what a server needs.
FROM python:3.11-slim AS wheel
WORKDIR /src
COPY pyproject.toml README.md LICENSE constraints.txt ./
COPY offline offline
COPY server server
COPY client client
COPY configs configs
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheel . \
    && python -m venv /opt/palpate \
    && /opt/palpate/bin/pip install --no-cache-dir --constraint constraints.txt "$(ls /wheel/*.whl)[recorder,metrics]"

# `docker build --target build -t palpate-build .`: builds models. Mount a folder with scenes at /models, for example
# `docker run --rm --user "$(id -u)" -v "$PWD:/models" palpate-build build configs/liver-coarse.toml -o liver.npz`.
FROM wheel AS build
RUN /opt/palpate/bin/pip install --no-cache-dir --constraint constraints.txt "$(ls /wheel/*.whl)[build]"
ENV PATH=/opt/palpate/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/tmp/numba
USER 10001
WORKDIR /models
ENTRYPOINT ["palpate"]
CMD ["build", "--help"]

# The default target serves: no compiler, no sources, not root, and none of the libraries that build models.
FROM python:3.11-slim AS serve
RUN useradd --create-home --uid 10001 palpate
COPY --from=wheel /opt/palpate /opt/palpate
ENV PATH=/opt/palpate/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/home/palpate/.cache/numba \
    NUMBA_CPU_NAME=generic
USER 10001
WORKDIR /models
# The kernels are compiled here, as the user that will run them: the server then starts in about a second.
RUN python -c "from palpate_server.session.warm_up import warm_up; warm_up(0.001, 1)"
EXPOSE 7447
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=5s --start-period=10s --retries=3 \
    CMD ["palpate", "health"]
ENTRYPOINT ["palpate"]
# Mount a folder with the model at /models. Listening beyond loopback is the container's decision, made here:
# publish the port only where it is wanted, for example `docker run -p 127.0.0.1:7447:7447`.
CMD ["serve", "model.npz", "--listen", "tcp/0.0.0.0:7447"]
