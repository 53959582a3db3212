"""Reports of a compensation, for one instrument and for several that were solved together."""

from piga.reports.compensation.page import brief, figures, page

__all__ = ["brief", "figures", "page"]
