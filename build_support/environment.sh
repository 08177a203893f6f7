# shellcheck shell=bash
# Sourced by ./quickstart and ./check: a virtual environment that holds torch and this package.
#
#   DSMOE_VENV    the environment's folder           (.venv in the repository)
#   DSMOE_PYTHON  the Python that it is made of      (python3)
#   DSMOE_TORCH   what pip is asked to install       (torch)
#   DSMOE_BUILD_CUDA, TORCH_CUDA_ARCH_LIST   as in setup.py; where neither is set and there is no GPU, ./quickstart leaves
#                                            the CUDA kernels out, and ./check compiles them

unset PYTHONPATH PYTHONHOME
cuda_without_gpu=0  # what DSMOE_BUILD_CUDA is by default; ./check says auto
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
case "${DSMOE_VENV-}" in '' | /*) ;; *) DSMOE_VENV=$PWD/$DSMOE_VENV ;; esac

fail() {
  printf 'error: %s\n' "$*" >&2
  exit 1
}

# step WHAT COMMAND...: runs the command quietly; where it fails, shows the end of what it said.
step() {
  local what=$1 begin=$SECONDS from watcher status=0
  shift
  printf '  %s ... ' "$what"
  from=$(wc -c 2>/dev/null <"$log" || echo 0)
  show_compiled "$what" "$((from + 1))" &
  watcher=$!
  "$@" >>"$log" 2>&1 || status=$?
  { kill $watcher && wait $watcher; } 2>/dev/null || true
  if [ $status -eq 0 ]; then
    printf 'done (%d s)\n' $((SECONDS - begin))
  else
    printf 'failed\n\n'
    tail -n 30 "$log" >&2
    fail "\"$what\" failed; the lines above are the end of $log"
  fi
}

# show_compiled WHAT FROM: says how many files are compiled, by what ninja wrote into the log from byte FROM on: on a
# terminal in place, else a line a minute. Ends with this script, however that ends.
show_compiled() {
  local every=60 format='\n    %s of %s files compiled (%d s) ... ' begin=$SECONDS now
  if [ -t 1 ]; then every=1 format="\r  $1 ... %s of %s files (%d s) ... "; fi
  while sleep "$every" >/dev/null 2>&1 && kill -0 $$ 2>/dev/null; do
    now=$(tail -c "+$2" "$log" | sed -n 's|^ *\[\([0-9]*\)/\([0-9]*\)\].*|\1 \2|p' | tail -n 1)
    # shellcheck disable=SC2059,SC2086
    if [ -n "$now" ]; then printf "$format" $now $((SECONDS - begin)); fi
  done
}

processors() { getconf _NPROCESSORS_ONLN 2>/dev/null || echo 1; }

check_prerequisites() {  # PYTHON
  local python=$1 debian="on Debian or Ubuntu: apt-get install"
  command -v "$python" >/dev/null || fail "there is no $python ($debian python3; DSMOE_PYTHON names another)"
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 8))' ||
    fail "$("$python" --version) is too old: 3.8 or newer is needed (DSMOE_PYTHON names another)"
  "$python" -c 'import venv, ensurepip' 2>/dev/null ||
    fail "$python cannot make virtual environments ($debian python3-venv)"
  "$python" -c 'import os, sysconfig as s; open(os.path.join(s.get_paths()["include"], "Python.h"))' 2>/dev/null ||
    fail "the headers of $python (Python.h) are missing ($debian python3-dev)"
  command -v "${CXX:-c++}" >/dev/null || command -v g++ >/dev/null ||
    fail "there is no C++ compiler ($debian g++)"
}

pip_install() { "$venv/bin/python" -m pip install --disable-pip-version-check "$@"; }

# A checksum of all that decides what gets installed. Not every path exists in every version.
fingerprint() {
  (
    cd "$root" || exit
    {
      find setup.py pyproject.toml CMakeLists.txt build_support diff_smoe_rasterization dsmoe integrations patches \
        -type f ! -name '*.py[co]' ! -name '*.so' ! -name _build_info.py -exec cksum {} + || true
      cat "$venv"/lib/python*/site-packages/torch/version.py || true
    } 2>/dev/null | LC_ALL=C sort
    echo "${torch_request[@]}" "${DSMOE_BUILD_CUDA:-$cuda_without_gpu}" "${TORCH_CUDA_ARCH_LIST-}"
    if nvidia-smi -L 2>/dev/null | grep -q .; then echo "a GPU"; fi  # for which the kernels are compiled
  ) | cksum
}

install_package() {
  local numpy=numpy
  # PyTorch before 2.3 was built against NumPy 1 and cannot exchange arrays with NumPy 2.
  "$venv/bin/python" -I -W ignore -c 'import sys, torch
sys.exit(tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 3))' && numpy='numpy<2'
  # Objects stay for the next build; assembled packages do not, or deleted modules would live on in them.
  rm -rf "$venv"/build/lib* "$venv"/build/bdist*
  printf '[build]\nbuild_base = %s\n' "$venv/build" >"$venv/build.cfg"
  # Without a GPU its kernels cannot run here: they are left out, or, where they are asked for, compiled for two
  # cards: some code is chosen by __CUDA_ARCH__ >= 800.
  if [ -z "${TORCH_CUDA_ARCH_LIST-}" ] &&
    "$venv/bin/python" -I -W ignore -c 'import sys, torch; sys.exit(torch.cuda.device_count() > 0)'; then
    local -x TORCH_CUDA_ARCH_LIST="7.5;8.0+PTX" DSMOE_BUILD_CUDA=${DSMOE_BUILD_CUDA:-$cuda_without_gpu}
  fi
  # -v: the log gets each file as it is compiled.
  DIST_EXTRA_CONFIG=$venv/build.cfg pip_install -v --no-build-isolation "$root" "$numpy"
}

# use_environment FOLDER [WORD...]: which environment the functions below mean; sets `venv`, `log` and `stamp`.
# The words ask pip for PyTorch; without any, the environment uses the packages of DSMOE_PYTHON, torch included.
use_environment() {
  venv=$1 log=$1/install.log stamp=$1/dsmoe.stamp
  shift
  torch_request=("$@")
}

up_to_date() {
  [ -f "$stamp" ] && { [ "$(cat "$stamp")" = "$(fingerprint)" ] ||
    [ "$(cat "$stamp")" = "$(cuda_without_gpu=auto fingerprint)" ]; }  # which has more than is needed
}

# Makes the environment where there is none, and installs what was asked for as PyTorch.
install_torch() {
  local python=${DSMOE_PYTHON:-python3} over_system=() tools=("setuptools>=61,<82" wheel ninja pybind11)
  if [ -n "${DSMOE_PYTHON-}" ] && [ -x "$venv/bin/python" ] &&
    [ "$("$python" --version)" != "$("$venv/bin/python" --version)" ]; then
    fail "$venv holds $("$venv/bin/python" --version), but DSMOE_PYTHON is $("$python" --version):" \
      "remove that folder, or name another one in DSMOE_VENV"
  fi
  [ ${#torch_request[@]} -gt 0 ] || over_system=(--system-site-packages)
  if [ -x "$venv/bin/pip" ]; then
    echo "Reusing the environment $venv and bringing it up to date (log: $log)"
  else
    check_prerequisites "$python"
    echo "Making the environment $venv with $("$python" --version) (log: $log)"
    mkdir -p "$venv"
    step "Creating it" "$python" -m venv "${over_system[@]}" "$venv"
  fi
  rm -f "$stamp"
  if [ ${#torch_request[@]} -gt 0 ]; then
    command -v cmake >/dev/null || tools+=(cmake)
    # --no-compile: Python compiles the modules that it imports, which are few of torch's.
    step "Installing PyTorch and build tools" \
      pip_install --no-compile "${torch_request[@]}" "${tools[@]}"
  fi
}

build_package() {
  step "Compiling and installing diff_smoe_rasterization" install_package
  step "Loading it" "$venv/bin/python" -I -c 'import diff_smoe_rasterization.rasterizer'
  fingerprint >"$stamp"
}

# prepare_environment FOLDER [WORD...]: makes, updates or reuses the environment, with this package in it.
prepare_environment() {
  use_environment "$@"
  if up_to_date; then
    echo "Reusing the environment $venv: nothing has changed since it was built."
    return
  fi
  install_torch
  build_package
}
