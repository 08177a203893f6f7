# shellcheck shell=bash
# Sourced by ./quickstart and ./check: a virtual environment that holds torch and this package.
#
#   DSMOE_VENV    the environment's folder           (.venv in the repository)
#   DSMOE_PYTHON  the Python that it is made of      (python3)
#   DSMOE_TORCH   what pip is asked to install       (torch)
#   DSMOE_WHEELS  where ./quickstart looks for a wheel of this package before it compiles one: a folder, the address of
#                 a page with links, or pip's options, such as "--index-url ADDRESS"
#   DSMOE_BUILD_CUDA, TORCH_CUDA_ARCH_LIST   as in setup.py; where neither is set and there is no GPU, ./quickstart leaves
#                                            the CUDA kernels out, and ./check compiles them

unset PYTHONPATH PYTHONHOME
cuda_without_gpu=0  # what DSMOE_BUILD_CUDA is by default; ./check says auto
takes_wheels=  # ./quickstart: what DSMOE_WHEELS says
wheel=  # its file, once it is fetched
build_tools=("setuptools>=61,<82" wheel ninja pybind11)
command -v cmake >/dev/null || build_tools+=(cmake)
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
  show_progress "$what" "$((from + 1))" &
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

# show_progress WHAT FROM: says how far a step is, by the log from byte FROM on: on a terminal in place, else a line a
# minute. Ends with this script, however that ends.
show_progress() {
  local every=60 format='\n    %s (%d s) ... ' begin=$SECONDS compiling now
  if [ -t 1 ]; then every=1 format="\r  $1 ... %s (%d s)\033[K "; fi
  while sleep "$every" >/dev/null 2>&1 && kill -0 $$ 2>/dev/null; do
    if [ -z "${compiling-}" ] && tail -c "+$2" "$log" | grep -q '^ *cost '; then compiling=$SECONDS; fi
    now=$(tail -c "+$2" "$log" | progress $((SECONDS - ${compiling:-$SECONDS})) "$(processors)")
    # shellcheck disable=SC2059
    if [ -n "$now" ] || [ -t 1 ]; then printf "$format" "$now" $((SECONDS - begin)); fi
  done
}

# progress SECONDS JOBS: what a step's log says of its progress, after so many seconds of compiling. setup.py wrote a
# line `cost SECONDS FILE` for each file, on one core, and ninja [NUMBER/NUMBER] after each. The machine's speed is that
# of what is compiled; half a minute at the usual speed is added, since files that are being compiled count as nothing.
progress() {
  awk -v seconds="$1" -v jobs="$2" '
    $1 == "cost" { cost[$3] = $2; total += $2; files++ }
    $1 == "Downloading" && /[MG]B\)$/ { count = split($2, path, "/"); download = path[count] " " $(NF - 1) " " $NF }
    match($0, /^ *\[[0-9]+\/[0-9]+\]/) {
      split(substr($0, RSTART, RLENGTH), number, /[^0-9]+/)
      name = $NF
      sub(/.*\//, "", name)
      sub(/\.o$/, "", name)
      done += cost[name]
      text = number[2] " of " number[3] " files compiled"
    }
    END {
      if (number[3] < files) total *= number[3] / files  # the others were compiled before
      left = (total - done) * (seconds + 30) / (done + 30 * jobs)
      if (text && total) text = text ", " (left > 90 ? int(left / 60 + 0.5) " min" : int(left + 0.5) " s") " left"
      print text ? text : download
    }'
}

processors() { getconf _NPROCESSORS_ONLN 2>/dev/null || echo 1; }

check_prerequisites() {  # PYTHON
  local python=$1 debian="on Debian or Ubuntu: apt-get install"
  command -v "$python" >/dev/null || fail "there is no $python ($debian python3; DSMOE_PYTHON names another)"
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 8))' ||
    fail "$("$python" --version) is too old: 3.8 or newer is needed (DSMOE_PYTHON names another)"
  "$python" -c 'import venv, ensurepip' 2>/dev/null ||
    fail "$python cannot make virtual environments ($debian python3-venv)"
}

check_compiler() {  # PYTHON
  local python=$1 debian="on Debian or Ubuntu: apt-get install"
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

# PyTorch before 2.3 was built against NumPy 1 and cannot exchange arrays with NumPy 2.
numpy_for_torch() {
  "$venv/bin/python" -I -W ignore -c 'import torch
print("numpy<2" if tuple(map(int, torch.__version__.split(".")[:2])) < (2, 3) else "numpy")'
}

install_package() {
  local numpy
  numpy=$(numpy_for_torch)
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
  [ -f "$stamp" ] && case "$(cat "$stamp")" in
    "$(fingerprint)") ;;
    "$(cuda_without_gpu=auto fingerprint)") ;;  # which has more than is needed
    "wheel $(fingerprint)") [ -n "$takes_wheels" ] ;;  # which need not be of this source
    *) false ;;
  esac
}

# Puts the wheel of this version that fits this Python into $venv/wheel, from where DSMOE_WHEELS says; fails if there is
# none.
fetch_wheel() {
  local places
  case "$takes_wheels" in
    -*) read -ra places <<<"$takes_wheels" ;;
    *) places=(--find-links "$takes_wheels" --no-index) ;;
  esac
  rm -rf "$venv/wheel"
  "$venv/bin/python" -m pip download --disable-pip-version-check --no-deps --only-binary :all: --dest "$venv/wheel" \
    "${places[@]}" "diff_smoe_rasterization==$(sed -n 's/^__version__ = "\(.*\)"/\1/p' \
      "$root/diff_smoe_rasterization/_version.py")" >>"$log" 2>&1
}

# Installs the wheel that was fetched; fails if it does not load with this PyTorch.
install_wheel() {
  step "Installing ${wheel##*/}" pip_install --force-reinstall --no-deps "$wheel"
  step "Installing what it needs" pip_install "$wheel" "$(numpy_for_torch)"
  "$venv/bin/python" -I -c 'import diff_smoe_rasterization.rasterizer' >>"$log" 2>&1
}

# Makes the environment where there is none, and installs what was asked for as PyTorch.
install_torch() {
  local python=${DSMOE_PYTHON:-python3} over_system=() tools=("${build_tools[@]}")
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
    [ -n "$takes_wheels" ] || check_compiler "$python"
    echo "Making the environment $venv with $("$python" --version) (log: $log)"
    mkdir -p "$venv"
    step "Creating it" "$python" -m venv "${over_system[@]}" "$venv"
  fi
  rm -f "$stamp"
  if [ -n "$takes_wheels" ]; then
    if fetch_wheel; then
      wheel=$(echo "$venv"/wheel/*.whl) tools=()
    else
      echo "  No wheel in $takes_wheels is of this version and fits this Python (log: $log): it is compiled"
      check_compiler "$venv/bin/python"
    fi
  fi
  if [ ${#torch_request[@]} -gt 0 ]; then
    if [ "${torch_request[*]}" = torch ] && ! "$venv/bin/python" -I -c 'import torch' 2>/dev/null; then
      echo "  PyTorch with its CUDA libraries is 3 GB to download: 4 minutes at 100 Mbit/s. Its build without CUDA is less:"
      echo "  DSMOE_TORCH=\"torch --index-url https://download.pytorch.org/whl/cpu\" ./quickstart"
    fi
    # --no-compile: Python compiles the modules that it imports, which are few of torch's.
    step "Installing PyTorch${tools:+ and build tools}" \
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
  if [ -n "$wheel" ]; then
    if install_wheel; then
      echo "wheel $(fingerprint)" >"$stamp"
      return
    fi
    echo "  The wheel does not load with this PyTorch (log: $log): it is compiled"
    check_compiler "$venv/bin/python"
    step "Installing build tools" pip_install "${build_tools[@]}"
  fi
  build_package
}
