#!/bin/sh
# Build the native module for 64-bit ARM with a cross compiler and run its tests under an emulator, with an ARM Python.
#   tools/neon.sh [PYTEST ARGUMENT...]    default: all tests of the native module but those that start programs
#   WHEEL=dist/....whl tools/neon.sh ...  test the package in a wheel for this Python instead; nothing is built
# It needs Debian's g++-aarch64-linux-gnu and qemu-user, which root installs here if they are missing. An ARM Python and the
# packages that the tests import, 1.1 GiB, go to build/neon and stay there. Nothing else on the machine changes.
set -eu
cd "$(dirname "$0")/.."
here=$PWD/build/neon
python=$PWD/.venv/bin/python
apt=$here/apt

fail() {
    echo "neon: $1" >&2
    exit 2
}

# torch 2.6 is the last whose ARM wheel is small; sympy is the version that it asks for.
packages="torch==2.6.0 sympy==1.13.1 mpmath typing_extensions filelock fsspec jinja2 markupsafe networkx numpy scipy pillow
    opencv-python-headless safetensors zstandard rich jaxtyping wadler-lindig beartype hypothesis sortedcontainers
    pytest iniconfig packaging pluggy pygments"

command -v apt-get > /dev/null || fail "there is no apt-get here; the ARM Python comes from Debian's packages"
if ! command -v aarch64-linux-gnu-g++ > /dev/null || ! command -v qemu-aarch64 > /dev/null; then
    [ "$(id -u)" = 0 ] || fail "install the packages g++-aarch64-linux-gnu and qemu-user first"
    echo "== neon: installing a cross compiler and an emulator"
    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends g++-aarch64-linux-gnu qemu-user; } \
        > /dev/null || fail "g++-aarch64-linux-gnu and qemu-user could not be installed"
fi

# The ARM packages have lists of their own, so that the machine's own packages are not touched.
if [ ! -e "$here/root/done" ]; then
    echo "== neon: fetching an ARM Python"
    rm -rf "$here/root"
    mkdir -p "$here/root" "$apt/state/lists/partial" "$apt/cache/archives/partial"
    : > "$apt/status"
    cat > "$apt/apt.conf" <<CONF
APT::Architecture "arm64";
APT::Architectures { "arm64"; };
APT::Sandbox::User "";
Dir::State "$apt/state";
Dir::State::status "$apt/status";
Dir::Cache "$apt/cache";
Dir::Log "$apt";
Debug::NoLocking "true";
CONF
    export APT_CONFIG="$apt/apt.conf"
    apt-get update -qq || fail "Debian's lists of ARM packages could not be fetched"
    apt-get install -y -qq --no-install-recommends --download-only python3-minimal python3-dev libstdc++6 > /dev/null ||
        fail "the ARM Python could not be fetched"
    for package in "$apt"/cache/archives/*.deb; do dpkg -x "$package" "$here/root"; done
    unset APT_CONFIG
    touch "$here/root/done"
fi
cd "$here/root/usr/bin"
version=$(echo python3.[0-9]*[0-9])
cd "$here/../.."

if [ ! -e "$here/site/done" ]; then
    echo "== neon: fetching the packages that the tests import"
    rm -rf "$here/site"
    grep -vE '^(torch|sympy)==' constraints.txt > "$here/constraints.txt"
    # shellcheck disable=SC2086
    "$python" -m pip install --quiet --disable-pip-version-check --no-deps --only-binary=:all: --target "$here/site" \
        --platform manylinux_2_28_aarch64 --platform manylinux_2_27_aarch64 --platform manylinux_2_26_aarch64 \
        --platform manylinux_2_17_aarch64 --platform manylinux2014_aarch64 --python-version "${version#python}" \
        -c "$here/constraints.txt" $packages || fail "the packages could not be fetched"
    touch "$here/site/done"
fi

if [ -n "${WHEEL:-}" ]; then
    echo "== neon: unpacking $WHEEL"
    rm -rf "$here/wheel"
    "$python" -m zipfile -e "$WHEEL" "$here/wheel" || fail "$WHEEL is no wheel; make wheels TARGETS=linux-aarch64 builds one"
    package=$here/wheel
    set -- -o pythonpath="tests conformance benchmarks ." "$@"
    [ $# -gt 2 ] || set -- "$@" tests/test_losses.py tests/test_noise.py tests/native/test_parity.py -m "not own_process"
    unset GSPLAT_TEST_NATIVE
else
    echo "== neon: building the native module for ARM"
    export PATH="$PWD/.venv/bin:$PATH"
    cmake -S . -B "$here/cmake" -G Ninja -DPython_EXECUTABLE="$python" -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64 \
        -DCMAKE_CXX_COMPILER=aarch64-linux-gnu-g++ -DPython_INCLUDE_DIR="$here/root/usr/include/$version" \
        -DCMAKE_CXX_FLAGS="-idirafter $here/root/usr/include" > "$here/cmake.log" 2>&1 || { cat "$here/cmake.log" >&2; exit 1; }
    cmake --build "$here/cmake" --target _native > "$here/build.log" 2>&1 || { cat "$here/build.log" >&2; exit 1; }
    mkdir -p "$here/module"
    cp "$here/cmake"/_native*.so "$here/module/_native.so"
    package=$PWD/src
    export GSPLAT_TEST_NATIVE="$here/module"
fi

[ $# -gt 0 ] || set -- tests/test_losses.py tests/test_noise.py tests/train/test_optimizer.py tests/mesh/test_volume.py tests/mesh/test_marching_cubes.py tests/native -m "not own_process"
echo "== neon: running $*"
unset OPENBLAS_CORETYPE
PYTHONPATH="$package:$here/site" OPENBLAS_NUM_THREADS=1 \
    qemu-aarch64 -L "$here/root" "$here/root/usr/bin/$version" -m pytest -q -p no:cacheprovider "$@"
echo "== neon: the native tests pass on 64-bit ARM, emulated"
