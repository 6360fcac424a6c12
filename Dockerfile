# torchtrack on the CPU, without root. Build it in a clone of the repository; run it in the folder of your files.
#
#   docker build -t torchtrack .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" -v torchtrack-cache:/cache torchtrack demo
#
# "demo" is any command of torchtrack. The volume keeps compiled kernels: without it, each start compiles them for a minute or two.
FROM python:3.11-slim AS build
WORKDIR /source
COPY pyproject.toml README.md LICENSE constraints.txt ./
COPY torchtrack torchtrack
# With the index for CPUs, pip takes torch's build for CPUs: the default one is for CUDA, and has some gigabytes more.
RUN python -m venv /opt/venv \
 && /opt/venv/bin/pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/cpu -c constraints.txt '.[fast]'

FROM python:3.11-slim
COPY --from=build /opt/venv /opt/venv
# Any user may run it: compiled kernels and Matplotlib's cache go to a folder that all may write to.
ENV PATH=/opt/venv/bin:$PATH \
    HOME=/cache \
    NUMBA_CACHE_DIR=/cache/numba \
    MPLCONFIGDIR=/cache/matplotlib
RUN useradd --home-dir /cache --create-home torchtrack && chmod 0777 /cache && mkdir /data && chown torchtrack /data
USER torchtrack
WORKDIR /data
ENTRYPOINT ["torchtrack"]
CMD ["--help"]
