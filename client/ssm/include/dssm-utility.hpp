// SPDX-License-Identifier: Apache-2.0
//
// Kept for programs that include it: the old DSSM's own helpers, which no program called, are gone.
#ifndef DSSM_DSSM_UTILITY_HPP
#define DSSM_DSSM_UTILITY_HPP

#include <libssm.h>
#include <stdio.h>

#include <iostream>
#include <mutex>
#include <type_traits>
#include <utility>
#include <vector>

#endif
