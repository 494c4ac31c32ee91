# Written to be read: no container engine ran where this was made, so it is linted (hadolint) and not tried.
# The pinned set of requirements.lock, checked by its hashes; nothing runs as root.
FROM python:3.11-slim AS build
WORKDIR /src
COPY requirements.lock pyproject.toml README.md LICENSE ./
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
RUN python -m venv /venv && grep -oE '^uv==[^ ;]+' requirements.lock | xargs /venv/bin/pip install --no-cache-dir
COPY hdt_core hdt_core
COPY pipelines pipelines
COPY docs docs
COPY dagster_batched dagster_batched
COPY sql sql
COPY extensions extensions
RUN /venv/bin/uv pip install --python /venv/bin/python --no-cache \
      --constraint requirements.lock --build-constraint requirements.lock '.[speed,ui,postgres,celery,serve,s3]' ./extensions

FROM python:3.11-slim
COPY --from=build /venv /venv
RUN useradd --uid 10001 --create-home hdt && install -d -o hdt -g hdt /home/hdt/data /home/hdt/data/dagster /landing
USER 10001
# the landing zone is only read; the home holds tables, ledger, catalog and Dagster's settings
ENV PATH=/venv/bin:$PATH HDT_LANDING=/landing HDT_HOME=/home/hdt/data DAGSTER_HOME=/home/hdt/data/dagster
WORKDIR /home/hdt
VOLUME /home/hdt/data
ENTRYPOINT ["hdt"]
CMD ["--help"]
