"""Native code of the equations of motion: what is traced, the tables that it runs by, and the C++ around it."""
