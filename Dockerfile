# The BIDS app of tetopt; docs/howto/containers.md has how it is built and run.
FROM python:3.12-slim

# By these VTK draws boundaries where there is no screen.
RUN apt-get update \
 && apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri \
 && rm -rf /var/lib/apt/lists/*

# Kernels are compiled once, below, for every processor of this architecture, not for that of the building machine alone.
ENV NUMBA_CPU_NAME=generic
ENV MPLBACKEND=agg

WORKDIR /opt/tetopt
COPY pyproject.toml README.md LICENSE ./
COPY phantoms ./phantoms
COPY tetopt ./tetopt
RUN python -m pip install --no-cache-dir --disable-pip-version-check ".[cohort,itk]"
# Kept where any user may read them; tetopt runs only those in a folder that is the user's own, so each run starts with a copy.
RUN NUMBA_CACHE_DIR=$PWD/kernels tetopt warm-up && chmod -R a+rX kernels

WORKDIR /
ENTRYPOINT ["sh", "-c", "export NUMBA_CACHE_DIR=$(mktemp -d) && (umask 077 && cp -r /opt/tetopt/kernels/. $NUMBA_CACHE_DIR); exec python -P -m tetopt.bids \"$@\"", "tetopt"]
