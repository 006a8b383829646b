# The checkout with the versions of constraints.txt, for a user without privileges: `make report` by default, `make test` on request.
FROM python:3.12-slim

RUN apt-get update \
 && apt-get install --yes --no-install-recommends make \
 && rm -rf /var/lib/apt/lists/*
RUN useradd --create-home calib && install --directory --owner=calib --group=calib /home/calib/checkout

USER calib
WORKDIR /home/calib/checkout
ENV PIP_NO_CACHE_DIR=1

COPY --chown=calib:calib . .
RUN make .venv/.ready

CMD ["make", "report"]
