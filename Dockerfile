# GenRe with everything pinned, as the worker of docker-compose.yml runs it.
FROM python:3.11-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends g++ make && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/genre
COPY pyproject.toml constraints.txt setup.py README.md ./
COPY benchmarks benchmarks
COPY configs configs
COPY flows flows
COPY genre_tasks genre_tasks
COPY storage storage
RUN python -m venv /opt/venv && /opt/venv/bin/pip install --no-cache-dir --constraint constraints.txt .

FROM python:3.11-slim
COPY --from=build /opt/venv /opt/venv
COPY prefect.yaml /app/prefect.yaml
# Flows are started from here, and read the presets beside them.
COPY flows /app/flows
COPY configs /app/configs
RUN useradd --create-home --uid 10001 genre && mkdir -p /var/lib/prefect /app/training && chown genre /var/lib/prefect /app /app/training
ENV PATH=/opt/venv/bin:$PATH DO_NOT_TRACK=1 PREFECT_SERVER_ANALYTICS_ENABLED=false
WORKDIR /app
USER genre
ENTRYPOINT []
CMD ["genre", "doctor"]
