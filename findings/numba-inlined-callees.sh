#!/usr/bin/env bash
# Numba 0.68.1: a function that is only ever inlined (forceinline=True) is optimised and turned into
# machine code by itself all the same, with a wrapper for calls from Python and one for C.
# Expected of "forceinline": the callee's code exists in its callers alone.
# Seen: seven functions that call one another, the last of them called by one kernel, have machine
# code of their own, nearly all twice (for any integer and for a constant one): 85 % of LLVM's time
# goes into code that nobody calls.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet numba==0.68.1 llvmlite==0.50.0 numpy==2.4.6
NUMBA_CACHE_DIR="$work/cache" "$work/venv/bin/python" - <<'PROGRAM'
import time
from numba import njit
from numba.core import codegen

spent, emitted = {}, []
def timed(name):
    function = getattr(codegen.CPUCodeLibrary, name)
    def wrapper(library, *args):
        start = time.process_time()
        try:
            return function(library, *args)
        finally:
            spent[library.name] = spent.get(library.name, 0.0) + time.process_time() - start
            if name == "_finalize_final_module":
                emitted.append(library.name)
    setattr(codegen.CPUCodeLibrary, name, wrapper)
timed("_optimize_final_module"), timed("_finalize_final_module")

def chain(depth):
    if depth == 0:
        @njit(forceinline=True)
        def first(a, i):
            return a[i] * 1.5 + a[i + 1]
        return first
    inner = chain(depth - 1)
    @njit(forceinline=True)
    def link(a, i):
        return inner(a, i) + (inner(a, i + 1) if a[i] > depth else a[i + 2])
    return link

callee = chain(6)
@njit
def caller(a):
    return callee(a, 0)

import numpy as np
caller(np.ones(100))
callees = [name for name in emitted if "link" in name or "first" in name]
apart = sum(seconds for name, seconds in spent.items() if name in callees)
share = apart / sum(spent.values())
print(f"{len(callees)} functions that are only inlined have machine code of their own: "
      f"{share:.0%} of the time that LLVM takes")
assert len(set(callees)) == 2 and len(callees) >= 7, callees
assert share > 0.6, share
PROGRAM
