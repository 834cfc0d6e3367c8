# gsba on Debian: `docker build -t gsba .`, then
# `docker run --rm --user "$(id -u)" -v "$PWD:/work" gsba` runs the demo and leaves it in ./gsba-demo.
# All that is done is in packaging/install.sh, which runs without containers, too.
FROM debian:bookworm-slim
COPY . /source
RUN sh /source/packaging/install.sh /source /opt/gsba && rm -rf /source
ENV PATH=/opt/gsba/bin:$PATH NUMBA_CACHE_DIR=/opt/gsba/kernels
WORKDIR /work
ENTRYPOINT ["gsba"]
CMD ["demo"]
