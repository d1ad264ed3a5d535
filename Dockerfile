# An image in which `make run` and `make test` pass: docker build -t mujoban . && docker run --rm -it mujoban
FROM python:3.12-slim-bookworm

RUN apt-get update && apt-get install -y --no-install-recommends \
        gcc g++ libc6-dev make git libegl1 libgl1-mesa-dri && \
    rm -rf /var/lib/apt/lists/*

# Nodes drop all rights that they do not need; the home folder takes numba's and Mesa's caches.
RUN useradd --create-home robot
WORKDIR /home/robot/mujoban
COPY --chown=robot . .
RUN chown robot .
USER robot
RUN make setup
CMD ["make", "run"]
