"""Becomes the process of an example script: what a shell sets up, in a copy of a process that has the imports done.

Its names without a definition are given by ``runpy.run_path``.
"""

# ruff: noqa: F821
import os
import runpy
import signal
import sys

os.setsid()
os.chdir(cwd)
os.environ.clear()
os.environ.update(environment)
for number, file in ((1, out), (2, err)):
    descriptor = os.open(file, os.O_WRONLY)
    os.dup2(descriptor, number)
    os.close(descriptor)
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the tests run in the background
sys.argv = [script, *arguments]
sys.path[0] = os.path.dirname(script)
runpy.run_path(script, run_name="__main__")
