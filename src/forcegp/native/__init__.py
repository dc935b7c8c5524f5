"""C++ code that is compiled on the user's machine, if there is a compiler."""
