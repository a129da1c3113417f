#!/bin/sh
# Build the native module with AddressSanitizer and UndefinedBehaviorSanitizer and run its tests on that build.
# Finite differences call the same kernels thousands of times over, so `make soak` alone runs those tests here.
# It reads 1,760 damaged files: 850 checkpoints of each strategy and 60 configurations, most of which are refused before
# native code runs; with GSPLAT_EDU_SOAK=1, thousands.
set -eu
cd "$(dirname "$0")/.."
python=$PWD/.venv/bin/python
build=$PWD/build/sanitize
export PATH="$PWD/.venv/bin:$PATH"
mkdir -p build
cmake -S . -B "$build" -G Ninja -DGSPLAT_SANITIZE=ON -DPython_EXECUTABLE="$python" > "$build.log" 2>&1 ||
    { cat "$build.log" >&2; exit 1; }
cmake --build "$build"
"$python" tools/check_objects.py "$build"
# Python itself is not instrumented, so the runtime comes in by preload; its own leaks, and torch's, are not ours.
preload="$(g++ -print-file-name=libasan.so) $(g++ -print-file-name=libubsan.so)"
but=
if [ "${GSPLAT_EDU_SOAK:-}" != 1 ]; then
    but="not gradcheck"
    export GSPLAT_EDU_FUZZ_CHECKPOINTS="${GSPLAT_EDU_FUZZ_CHECKPOINTS:-850}" GSPLAT_EDU_FUZZ_CONFIGS="${GSPLAT_EDU_FUZZ_CONFIGS:-60}"
fi
LD_PRELOAD="$preload" ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1 \
    GSPLAT_TEST_NATIVE="$build" "$python" -m pytest -q -n "${WORKERS:-2}" --dist loadfile tests/native tests/compat/test_surfels.py tests/compat/test_screen.py tests/mesh/test_volume.py tests/mesh/test_marching_cubes.py tests/test_losses.py tests/test_noise.py tests/test_recolor.py tests/train/test_optimizer.py \
    tests/train/test_checkpoint.py tests/fuzz/test_checkpoints.py tests/fuzz/test_configs.py -m "not own_process" -k "$but" -p no:cacheprovider --capture=sys
