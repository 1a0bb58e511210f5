# The terminal in a container:
#
#   docker build -t jaxreg .
#   docker run --rm -v "$PWD:/data" -v jaxreg:/home/any --user "$(id -u):$(id -g)" \
#       jaxreg multiview scans/
#
# The volume keeps compiled programs for the next run.
FROM python:3.13-slim AS build
WORKDIR /source
COPY pyproject.toml README.md LICENSE ./
COPY .ci/metadata.py .ci/
COPY jaxreg jaxreg
RUN python -m pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.13-slim
RUN --mount=type=bind,from=build,source=/wheels,target=/wheels \
    python -m pip install --no-cache-dir "$(echo /wheels/*.whl)[app,formats]"
# Whoever runs it may write there.
RUN mkdir -m 1777 /home/any
ENV HOME=/home/any
WORKDIR /data
ENTRYPOINT ["jaxreg"]
CMD ["--help"]
