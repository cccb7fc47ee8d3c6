// SPDX-License-Identifier: Apache-2.0
//
// The prototype's name of dssm-proxy-client.hpp.
#ifndef DSSM_SSM_PROXY_CLIENT_HPP
#define DSSM_SSM_PROXY_CLIENT_HPP

#include "dssm-proxy-client.hpp"
#include "dssm-utility.hpp"

#endif
