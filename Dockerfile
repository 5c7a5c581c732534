# Stage 1 builds the wheel and installs it, with the pinned versions, into a virtual environment.
FROM python:3.11-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE constraints.txt ./
COPY offline offline
COPY server server
COPY client_examples client_examples
COPY configs configs
RUN python -m venv /opt/palpate \
    && /opt/palpate/bin/pip install --no-cache-dir --constraint constraints.txt ".[recorder,metrics]"

# Stage 2 runs it: no compiler, no sources, not root.
FROM python:3.11-slim
RUN useradd --create-home --uid 10001 palpate
COPY --from=build /opt/palpate /opt/palpate
ENV PATH=/opt/palpate/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/home/palpate/.cache/numba \
    NUMBA_CPU_NAME=generic
USER 10001
WORKDIR /models
# The kernels are compiled here, as the user that will run them: the server then starts in about a second.
RUN python -c "from palpate_server.session.server import warm_up; warm_up(0.001, 1)"
EXPOSE 7447
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=5s --start-period=10s --retries=3 \
    CMD ["palpate", "health"]
ENTRYPOINT ["palpate"]
# Mount a folder with the model at /models. Listening beyond loopback is the container's decision, made here:
# publish the port only where it is wanted, for example `docker run -p 127.0.0.1:7447:7447`.
CMD ["serve", "model.npz", "--listen", "tcp/0.0.0.0:7447"]
