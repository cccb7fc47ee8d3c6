// SPDX-License-Identifier: Apache-2.0
//
// Kept for programs that include it, and empty: no program called the old DSSM's own helpers.
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
