"""Readers of HDF5, MATLAB, TDMS and XLSX files. They run in a separate process."""
