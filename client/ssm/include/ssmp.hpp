// SPDX-License-Identifier: Apache-2.0
//
// SSMPApi<T, P>: a stream whose sample size is decided by alloc(), with callbacks that pack and
// unpack it. Source-compatible with SSM's <ssmp.hpp>; see docs/ssm.md.
#ifndef DSSM_SSMP_HPP
#define DSSM_SSMP_HPP

#include <cstdlib>

#include "ssm.hpp"

#define SSMApiP SSMPApi

template <typename T, typename P = SSMDummy>
class SSMPApi : public SSMApiBase {
 public:
  T* data;  // NULL until alloc()
  P property;
  void (*writeData)(void* ssmp, const void* data, void* userData);  // NULL: plain copy
  void (*readData)(const void* ssmp, void* data, void* userData);   // NULL: plain copy
  void* userData;                                                   // handed to both

  SSMPApi() { clear(); }
  SSMPApi(const char* newName, int newId = 0) : SSMApiBase(newName, newId) { clear(); }
  ~SSMPApi() { std::free(data); }

  // Allocates `newDataSize` bytes for `data`; what was allocated before is freed.
  bool alloc(size_t newDataSize) {
    void* memory = std::malloc(newDataSize);
    if (!memory) return false;
    std::free(data);
    data = static_cast<T*>(memory);
    setDataBuffer(memory, newDataSize);
    return true;
  }

  bool write(ssmTimeT writeTime = gettimeSSM()) {
    if (!writeData) return SSMApiBase::write(writeTime);
    const SSM_tid tid = writeSSMP(ssmId, data, writeTime, writeData, userData);
    if (tid < 0) return false;
    timeId = tid;
    time = writeTime;
    return true;
  }

  bool read(int readId = -1) {
    if (!readData) return SSMApiBase::read(readId);
    const SSM_tid tid = readSSMP(ssmId, data, &time, readId, readData, userData);
    if (tid < 0) return false;
    timeId = tid;
    return true;
  }

 private:
  SSMPApi(const SSMPApi&);  // owns `data`: not copyable
  SSMPApi& operator=(const SSMPApi&);

  void clear() {
    data = 0;
    writeData = 0;
    readData = 0;
    userData = 0;
    setPropertyBuffer(&property, sizeof(P));
  }
};

#endif
