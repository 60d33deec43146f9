/** @file koopmpc_daqp.c @brief The three sources of DAQP that solve a problem, in this controller's precision. */
#include "koopmpc_names.h"
#include "koopmpc_sizes.h"

#include "daqp/auxiliary.c"
#include "daqp/daqp.c"
#include "daqp/factorization.c"
