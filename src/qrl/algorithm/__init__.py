"""The paper's method as pure functions of arrays: no disk, no devices, no worlds."""
