"""The comparative harness: suites of training runs, measured alike, and what is reported of them; see README.md here.

    dsmoe bench run SUITE.yaml -o RESULTS       suite.py: a suite is read and expanded to cells; engine.py runs them
    dsmoe bench report RESULTS -o report/       report/: tables, curves and a page

The other files here are commands that time kernels; they are run by themselves.
"""
