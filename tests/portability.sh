#!/usr/bin/env bash
# Run the quick tests under what differs between machines, as far as one machine can show it; ten times the time of
# `pytest`, or that of the conditions that are named:
#
#   tests/portability.sh                     # all
#   tests/portability.sh avx2 threads-4      # these
#   tests/portability.sh -- -m slow          # all, with other arguments for pytest
#
# The ordinary user tests a clone, of what is committed; as root, with a Python that others may read. OUT names the folder
# of the outputs.
set -uo pipefail
cd "$(dirname "$0")/.."
out=${OUT:-$(mktemp -d)}
wanted=()
while (($#)) && [[ $1 != -- ]]; do wanted+=("$1") && shift; done
shift || true
arguments=("$@")
failed=()

asked() { ((${#wanted[@]} == 0)) || [[ " ${wanted[*]} " == *" $1 "* ]]; }

check() { # name, then the command before pytest
    local name=$1 && shift
    asked "$name" || return
    if "$@" "${python:-python}" -m pytest -q "${arguments[@]}" >"$out/$name.txt" 2>&1; then
        echo "$name: $(tail -n 1 "$out/$name.txt")"
    else
        failed+=("$name")
        echo "$name: FAILED, see $out/$name.txt" && grep -E "^(FAILED|ERROR)" "$out/$name.txt"
    fi
}

# Instructions of the processor: of torch's own loops, of MKL's matrix products, and of oneDNN's.
check default env ATEN_CPU_CAPABILITY=default
check avx2 env ATEN_CPU_CAPABILITY=avx2
check avx512 env ATEN_CPU_CAPABILITY=avx512
check other-products env MKL_CBWR=COMPATIBLE ONEDNN_MAX_CPU_ISA=SSE41

for threads in 1 2 3 4; do check "threads-$threads" env OMP_NUM_THREADS="$threads"; done

check one-process env PYTEST_ADDOPTS="-n 0"
check no-data env CA_REG_DATA=/nonexistent

# As where Triton has no wheels.
mkdir -p "$out/no-triton" && echo 'import sys; sys.modules["triton"] = None' >"$out/no-triton/sitecustomize.py"
check no-triton env PYTHONPATH="$out/no-triton"

# A compiler that fails, and a PATH without one.
check broken-compiler env CC=/bin/false CXX=/bin/false
rm -rf "$out/bin" && mkdir -p "$out/bin"
IFS=: read -ra folders <<<"$PATH"
for folder in "${folders[@]}"; do
    find -L "$folder" -maxdepth 1 -type f -executable 2>/dev/null
done | grep -vE '/([^/]*-)?(cc|c\+\+|gcc|g\+\+|clang|clang\+\+)(-[0-9.]+)?$' | while read -r program; do
    [[ -e $out/bin/${program##*/} ]] || printf '#!/bin/sh\nexec "%s" "$@"\n' "$program" >"$out/bin/${program##*/}"
done
chmod -R a+rx "$out/bin"
check no-compiler env PATH="$out/bin"

finish() { ((${#failed[@]})) && echo "failed: ${failed[*]}" && exit 1 || exit 0; }

asked ordinary-user || finish
# A clone that its user cannot write to, below a path with spaces, without a home.
user=${CHECK_USER:-nobody} clone="$out/a path with spaces/ca reg"
rm -rf "$out/a path with spaces"
git clone --quiet . "$clone"
python -m venv --without-pip "$out/a path with spaces/venv"
python=$out/a\ path\ with\ spaces/venv/bin/python
site=$("$python" -c 'import site; print(site.getsitepackages()[0])')
python -c 'import sys; print(*(x for x in sys.path if x.endswith("-packages")), sep="\n")' >"$site/base.pth"
python -m pip --python "$python" install --quiet --no-deps -e "$clone"
chmod -R a+rX "$out"
mkdir -p "$out/temporary" && chmod 1777 "$out/temporary"
cd "$clone" || exit
if ((EUID)); then
    chmod -R a-w "$clone" # the owner is refused as well
    check ordinary-user env HOME=/nonexistent TMPDIR="$out/temporary"
else
    check ordinary-user setpriv --reuid "$user" --regid "$(id -g "$user")" --clear-groups \
        env HOME=/nonexistent TMPDIR="$out/temporary"
fi

finish
