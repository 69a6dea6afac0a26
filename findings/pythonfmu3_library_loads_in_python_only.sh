#!/usr/bin/env bash
# pythonfmu3 0.3.4, Linux: the library of an FMU outside a Python process. Needs a C compiler, and a python3 with a shared libpython.
#
# A good guess: a simulator in C or C++ on a computer that has this Python loads the FMU. modelDescription.xml says
# needsExecutionTool="true", and the execution tool, Python, is there.
#
# What happens: binaries/x86_64-linux/NAME.so uses the functions of libpython but is not linked to it (it has no such entry among
# its needed libraries), so that it loads in a process that is Python itself, as FMPy is, and in no other:
#   dlopen in a C program                          undefined symbol: _Py_NoneStruct
#   the same with libpython preloaded              loaded, and fmi3GetVersion says 3.0
# Run such an FMU with FMPy, or start the simulator with LD_PRELOAD=.../libpython3.x.so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pythonfmu3==0.3.4
cat > "$folder/slave.py" <<'PYTHON'
from pythonfmu3 import Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability


class Adder(Fmi3Slave):
    def __init__(self, **options):
        super().__init__(**options)
        self.time, self.u, self.x = 0.0, 0.0, 0.0
        independent = {"causality": Fmi3Causality.independent, "variability": Fmi3Variability.continuous}
        self.register_variable(Float64("time", **independent))
        self.register_variable(Float64("u", causality=Fmi3Causality.input))
        self.register_variable(Float64("x", causality=Fmi3Causality.output))

    def do_step(self, time, step):
        self.x += step * self.u
        return True
PYTHON
cat > "$folder/host.c" <<'C'
#include <dlfcn.h>
#include <stdio.h>

int main(int count, char **words) {
    void *library = dlopen(words[1], RTLD_NOW);
    if (!library) {
        const char *why = dlerror();
        for (const char *c = why; *c; c++)
            if (*c == ':') why = c + 2;
        printf("not loaded: %s\n", why);
        return 0;
    }
    const char *(*version)(void) = (const char *(*)(void))dlsym(library, "fmi3GetVersion");
    printf("loaded: FMI %s\n", version());
    return 0;
}
C
cc -o "$folder/host" "$folder/host.c" -ldl
(cd "$folder" && venv/bin/pythonfmu3 build -f slave.py > log 2>&1 && venv/bin/python -m zipfile -e Adder.fmu fmu)
library=$folder/fmu/binaries/x86_64-linux/Adder.so
python=$("$folder/venv/bin/python" -c 'import sysconfig as s; print(s.get_config_var("LIBDIR") + "/" + s.get_config_var("INSTSONAME"))')
seen="C program, $("$folder/host" "$library")
with libpython, $(LD_PRELOAD=$python "$folder/host" "$library")"
expected="C program, not loaded: _Py_NoneStruct
with libpython, loaded: FMI 3.0"
# A good guess has "loaded: FMI 3.0" in both lines.
printf '%s\n' "$seen"
diff <(printf '%s\n' "$expected") <(printf '%s\n' "$seen") && echo "as written above"
