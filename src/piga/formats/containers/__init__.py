"""HDF5, MATLAB, TDMS and XLSX files, read in a process of their own."""
