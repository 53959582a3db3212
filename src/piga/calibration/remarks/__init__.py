"""Remarks on a finished calibration: leverage, missing terms, creep, data read wrongly.

A remark that can move a coefficient by more than u is a doubt (``notes``); the others are ``remarks``.

One cause gets one remark. Data that were read wrongly look as if terms were missing, and a missing term affects single
segments. Advice on the data therefore suppresses suggestions of terms, and both suppress remarks on segments that
move a coefficient. Remarks change no result. All remarks use a fit without slow noise, because slow noise joins the segments
and absorbs the signature of a missing term. A suggestion states this.
"""
