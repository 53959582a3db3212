"""The workbench: a local page in the browser to look at records, calibrate them and compensate with them.

Everything it does is a call of the public Python interface or a command of ``piga``, and every file that it writes is
the file of that command. It computes no number of its own. See docs/how-to/workbench.md.
"""
