#!/bin/sh
# Make .venv and install the package into it, or say that it is there already.
#   tools/set_up.sh         what `make demo` needs
#   tools/set_up.sh dev     what `make test`, `make check` and `make notebooks` need as well
# PYTHON names the interpreter (default: python3).
set -eu
cd "$(dirname "$0")/.."
extra=${1:-}
python=${PYTHON:-python3}
want=$(cat pyproject.toml constraints.txt | cksum)

# A stamp is written last, so an interrupted set-up is done again. The folder is in it: a moved .venv is not used.
stamp() { printf '%s %s\n' "$want" "$PWD"; }
for done_by in .venv/.set-up-dev ${extra:+none} .venv/.set-up-; do
    [ "$done_by" = none ] && break
    if [ -f "$done_by" ] && [ "$(cat "$done_by")" = "$(stamp)" ]; then
        echo "== set-up: already installed in .venv, skipped"
        exit 0
    fi
done

command -v "$python" > /dev/null || {
    echo "set-up: no '$python' here; install Python 3.11 or newer, or name one: make PYTHON=python3.12 ..." >&2
    exit 2
}
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "set-up: $("$python" --version 2>&1) is too old; name a Python from 3.11 on: make PYTHON=python3.12 ..." >&2
    exit 2
}
echo "== set-up: making .venv with $("$python" --version)"
"$python" -m venv --clear .venv || {
    echo "set-up: '$python -m venv' failed; on Debian and Ubuntu install the package python3-venv" >&2
    exit 2
}
echo "== set-up: installing gsplat_edu${extra:+ with the extra $extra} and the versions in constraints.txt"
.venv/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".${extra:+[$extra]}" || {
    echo "set-up: the installation failed; the lines above say why" >&2
    exit 2
}
stamp > ".venv/.set-up-$extra"
echo "== set-up: done"
