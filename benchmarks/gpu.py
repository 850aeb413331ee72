"""The first minute on a card, and what can be shown without one."""

import sys
from benchmarks import ahead as A

if __name__ == "__main__":
    rows = []
    for t in sys.argv[2:] or A.TARGETS:
        for k in A.KERNELS:
            try:
                rows.append(A.compile_ahead(k, t))
            except Exception as e:
                print("failed", k.label, t, repr(e)[:300])
        print(t, [(r.kernel, r.registers, r.spills, r.per_entry) for r in rows if r.target == t], flush=True)
    print(A.markdown(rows))
