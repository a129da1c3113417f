#!/bin/sh
# Make .venv and install the package into it, or say that it is there already.
#   tools/set_up.sh demo    what `make demo` needs
#   tools/set_up.sh course  what the chapters and JupyterLab need as well
#   tools/set_up.sh dev     what `make test`, `make check` and `make notebooks` need as well
#   tools/set_up.sh wheels  what `make wheels` needs: it compiles nothing for this .venv
# PYTHON names the interpreter (default: python3).
set -eu
cd "$(dirname "$0")/.."
purpose=$1
python=${PYTHON:-python3}

fail() {
    echo "set-up: $1" >&2
    exit 2
}

# A stamp is written last, so that an interrupted set-up is done again.
stamp=$(cat pyproject.toml constraints.txt CMakeLists.txt native/* wasm/* tools/build_wasm.py | cksum)
stands() { [ "$(cat ".venv/.set-up-$1" 2> /dev/null)" = "$stamp" ]; }

# A .venv is used if it runs, was not moved here from elsewhere, and has the Python that was asked for.
usable() {
    .venv/bin/python -c 'pass' 2> /dev/null || return 1
    grep -q "^VIRTUAL_ENV=.*$PWD/.venv" .venv/bin/activate || return 1
    [ -z "${PYTHON:-}" ] || [ "$("$PYTHON" --version 2>&1)" = "$(.venv/bin/python --version 2>&1)" ]
}

if usable && { stands "$purpose" || { [ "$purpose" != wheels ] && stands dev; } || { [ "$purpose" = demo ] && stands course; }; }; then
    echo "== set-up: already installed in .venv, skipped"
    exit 0
fi
command -v c++ > /dev/null || command -v g++ > /dev/null || command -v clang++ > /dev/null ||
    fail "there is no C++ compiler for the native kernels; on Debian and Ubuntu install the package g++"
if ! usable; then
    hint="name a Python from 3.11 on: make PYTHON=python3.12 ..."
    command -v "$python" > /dev/null || fail "there is no '$python'; $hint"
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2> /dev/null ||
        fail "'$python' does not run or is older than 3.11; $hint"
    echo "== set-up: making .venv with $("$python" --version)"
    "$python" -m venv --clear .venv ||
        fail "'$python -m venv' failed; on Debian and Ubuntu the package python3-venv is missing"
fi
extra=
[ "$purpose" = demo ] || extra="[$purpose]"
echo "== set-up: installing gsplat_edu$extra with the versions in constraints.txt"
.venv/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".$extra" ||
    fail "the installation failed; the lines above say why"
if [ "$purpose" = dev ]; then
    echo "== set-up: building the module for browsers"
    .venv/bin/python tools/build_wasm.py || fail "the module for browsers was not built; the line above says why"
fi
echo "$stamp" > ".venv/.set-up-$purpose"
if [ "$purpose" = dev ] && [ -e .git ] && ! git config --get core.hooksPath > /dev/null; then
    git config core.hooksPath tools/hooks
fi
echo "== set-up: done"
