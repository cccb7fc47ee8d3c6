// SPDX-License-Identifier: Apache-2.0
//
// PConnectorClient<T, P>: the prototype's name of DSSMApi, with all that DSSMApi has: programs of
// the versions in between use both.
#ifndef DSSM_SSM_PROXY_CLIENT_CHILD_HPP
#define DSSM_SSM_PROXY_CLIENT_CHILD_HPP

#include "dssm.hpp"
#include "ssm-proxy-client.hpp"

template <typename T, typename P = DSSMDummy>
class PConnectorClient : public DSSMApi<T, P> {
 public:
  PConnectorClient() {}
  PConnectorClient(const char* newName, int newId = 0, const char* ipAddr = "127.0.0.1")
      : DSSMApi<T, P>(newName, newId, ipAddr) {}
};

#endif
