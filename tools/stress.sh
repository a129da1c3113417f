#!/bin/sh
# Repeat a command with slow tabs beside eight busy processes, and stop at the first failure. `make stress` calls it.
#   tools/stress.sh ROUNDS COMMAND...
set -u
rounds=$1
shift
busy=
for _ in 1 2 3 4 5 6 7 8; do
    while :; do :; done &
    busy="$busy $!"
done
# shellcheck disable=SC2064,SC2086  # the processes of now, several of them
trap "kill $busy" EXIT
export GSPLAT_EDU_SLOW_TABS=6
round=1
while [ "$round" -le "$rounds" ]; do
    echo "== stress: round $round of $rounds"
    env "$@" || exit 1
    round=$((round + 1))
done
echo "== stress: no failure in $rounds rounds"
