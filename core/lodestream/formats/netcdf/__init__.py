"""NetCDF and HDF5 files, among them VMEC's."""
