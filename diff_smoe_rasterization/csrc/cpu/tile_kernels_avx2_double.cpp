// The same for double. Its namespace is its own, because it is compiled with other flags.
#define DSMOE_DOUBLE
#include "tile_kernels_avx2.cpp"  // NOLINT(bugprone-suspicious-include)
