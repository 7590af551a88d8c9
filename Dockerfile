# Everything of the README in a container:
#   docker build -t robo_manip_baselines .
#   docker run --rm -it -v "$PWD/results:/app/results" robo_manip_baselines python bin/Rollout.py --help
FROM python:3.12-slim-bookworm

# Where PyTorch comes from: the small build without CUDA, or https://pypi.org/simple with it.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu

# Rendering without a display: EGL, with Mesa's software renderer where there is no GPU.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=egl

WORKDIR /app
COPY pyproject.toml setup.py constraints.txt README.md LICENSE ./
COPY robo_manip_baselines robo_manip_baselines
COPY face_prediction face_prediction
RUN pip install --no-cache-dir --extra-index-url "$TORCH_INDEX" \
    -c constraints.txt -e ".[train,face-prediction]"
COPY bin bin
COPY examples examples

# Fails here, with the reason, where no image can be rendered.
RUN python -m robo_manip_baselines.envs.mujoco.cell.opengl

CMD ["python", "bin/Rollout.py", "--help"]
