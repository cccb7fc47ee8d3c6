// SPDX-License-Identifier: Apache-2.0
//
// DSSMApi<T, P, U>: a stream of T with a property P on another PC, and a block U that this PC shows
// to all others. Source-compatible with the old DSSM; what each call returns is in docs/ssm.md.
// Compiles as C++11 and later.
//
//   writing   fill *wdata, then write(); `data` is not sent
//   reading   read(), readNew() ... fill `data`: one round trip over the network each
//   buffered  after readyRingBuf() a thread collects the stream's samples, beginning with the
//             oldest one that its owner holds, and the ...Buf functions read each of them here
#ifndef DSSM_DSSM_HPP
#define DSSM_DSSM_HPP

#include <sys/poll.h>

#include <cstring>
#include <functional>
#include <iostream>
#include <memory>
#include <new>
#include <string>
#include <thread>
#include <vector>

#include "dssm-def.hpp"
#include "dssm-proxy-client.hpp"
#include "dssm-utility.hpp"

template <typename T, typename P = DSSMDummy, typename U = DSSMDummy>
class DSSMApi : public PConnector {
 public:
  // What another host shows; `data` only where data_flg.
  struct BrInfo {
    std::string ipaddr;
    std::string port;
    bool data_flg;
    U data;
  };

  T data;          // filled by reads
  T* wdata;        // sent by write()
  P property;      //
  void* fulldata;  // a time, and *wdata after it
  U br_data;
  U* pbr_data;

  DSSMApi() { useOwnMembers(); }
  DSSMApi(const char* newName, int newId = 0, const char* ipAddr = "127.0.0.1")
      : PConnector(newName, newId, ipAddr) {
    useOwnMembers();
  }
  ~DSSMApi() {
    wdata->~T();
    ::operator delete(mBlock);
  }

  // Shows br_data to all hosts of the fleet: hands it to this PC's dssmd.
  bool sendBroadcast() {
    return dssm_ssm_remote_send_broadcast(remote(), &br_data, sizeof(U)) != 0;
  }
  // All hosts that this PC's dssmd knows at this moment, itself included.
  std::vector<BrInfo> receiveBroadcast() {
    std::vector<BrInfo> hosts;
    dssm_ssm_remote_receive_broadcast(remote(), &takeBroadcast, &hosts);
    if (hosts.empty())
      std::cerr << "receiveBroadcast() : nothing is known of any host" << std::endl;
    return hosts;
  }

  // Collects the samples of the last `life` seconds; 0: as last time, at first what the stream has.
  void readyRingBuf(ssmTimeT newLife = 0.0, ssmTimeT newCycle = 0.0) override {
    PConnector::readyRingBuf(newLife, newCycle);
  }

  // As the functions without Buf, on what was collected.
  bool readBuf(SSM_tid tid_in = -1) {
    return take(1, tid_in < 0 ? DSSM_SSM_NEWEST : DSSM_SSM_TID, tid_in, 0, 0);
  }
  bool readNewBuf() { return take(1, DSSM_SSM_NEWER, timeId, 0, 0); }
  bool readNextBuf(int dt = 1) { return take(1, DSSM_SSM_NEXT, timeId, dt, 0); }
  bool readBackBuf(int dt = 1) { return dt <= timeId ? readBuf(timeId - dt) : false; }
  bool readLastBuf() { return readBuf(-1); }
  bool readTimeBuf(ssmTimeT ytime) { return take(1, DSSM_SSM_AT, 0, 0, ytime); }
  SSM_tid getTID_topBuf(SSM_sid) { return hasDataCon() ? dssm_ssm_remote_top(remote(), 1) : -1; }

 private:
  void* mBlock;  // memory of fulldata

  void useOwnMembers() {
    // The time stands right before *wdata, whatever alignment T has.
    std::size_t space = sizeof(ssmTimeT) + alignof(T) + sizeof(T);
    mBlock = ::operator new(space);
    space -= sizeof(ssmTimeT);
    void* place = static_cast<char*>(mBlock) + sizeof(ssmTimeT);
    std::align(alignof(T), sizeof(T), place, space);
    wdata = new (place) T();
    fulldata = static_cast<char*>(place) - sizeof(ssmTimeT);
    pbr_data = &br_data;
    setBuffer(&this->data, sizeof(T), &this->property, sizeof(P), fulldata);
  }

  static void takeBroadcast(const char* address, const char* port, const void* block, size_t size,
                            void* user_data) {
    BrInfo info = BrInfo();
    info.ipaddr = address;
    info.port = port;
    info.data_flg = block != nullptr && size == sizeof(U);
    if (info.data_flg) std::memcpy(static_cast<void*>(&info.data), block, sizeof(U));
    static_cast<std::vector<BrInfo>*>(user_data)->push_back(info);
  }
};

// A stream without a property; V is the block for the other hosts.
template <typename S, typename V>
using DSSMApiWithProp = DSSMApi<S, DSSMDummy, V>;

#endif
