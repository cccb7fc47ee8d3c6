// SPDX-License-Identifier: Apache-2.0
//
// PConnector: one stream of another PC, in one direction, for a program that needs no dssmd on its
// own PC. Source-compatible with the old DSSM's class of this name; what each call returns stands
// in docs/ssm.md. Programs use it through DSSMApi (dssm.hpp) or PConnectorClient
// (ssm-proxy-client-child.hpp), which have the data. Compiles as C++11 and later.
//
//   order    initRemote(), create() or open(), the property, createDataCon(); then read or write
//   address  "192.168.0.10", "192.168.0.10:13776", "[::1]:13776", "pc2"; without a port $DSSM_PORT,
//            else 13776
//   signals  release() and terminate() may be called from a signal handler at any moment; a read or
//            write over the network in a handler that interrupted another one fails
#ifndef DSSM_DSSM_PROXY_CLIENT_HPP
#define DSSM_DSSM_PROXY_CLIENT_HPP

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <sys/types.h>

#include <cstring>
#include <iostream>
#include <string>

#include "dssm-def.hpp"
#include "libssm.h"

extern "C" {
// Between these headers and libssm; not for programs.

struct dssm_ssm_remote;
struct dssm_ssm_remote* dssm_ssm_remote_new(void);
void dssm_ssm_remote_delete(struct dssm_ssm_remote* remote);

// The dssmd at `address` answers (1), or not, or a signal handler ran meanwhile (0).
int dssm_ssm_remote_connect(struct dssm_ssm_remote* remote, const char* address);
// 1, or 0 and a line on stderr. Opening waits for the stream, as connecting waits for dssmd.
int dssm_ssm_remote_create(struct dssm_ssm_remote* remote, const char* address, const char* name,
                           int id, size_t size, ssmTimeT life, ssmTimeT cycle);
int dssm_ssm_remote_open(struct dssm_ssm_remote* remote, const char* address, const char* name,
                         int id, size_t size);
int dssm_ssm_remote_is_open(struct dssm_ssm_remote* remote);
void dssm_ssm_remote_close(struct dssm_ssm_remote* remote); /* async-signal-safe */

// What to read: the newest; number `tid`; the newest if it is newer than `tid`; the one `dt` after
// `tid`, or the oldest where that is no longer held; the newest with a time <= `time`.
enum dssm_ssm_remote_which {
  DSSM_SSM_NEWEST,
  DSSM_SSM_TID,
  DSSM_SSM_NEWER,
  DSSM_SSM_NEXT,
  DSSM_SSM_AT
};
// The tid of what was read into `data`, or an SSM_ERROR_...; `buffered`: from the ring of
// dssm_ssm_remote_buffer() instead of over the network.
SSM_tid dssm_ssm_remote_read(struct dssm_ssm_remote* remote, int buffered, int which, SSM_tid tid,
                             int dt, ssmTimeT time, void* data, size_t size, ssmTimeT* ret_time);
SSM_tid dssm_ssm_remote_top(struct dssm_ssm_remote* remote, int buffered);
SSM_tid dssm_ssm_remote_bottom(struct dssm_ssm_remote* remote);
SSM_tid dssm_ssm_remote_tid_at(struct dssm_ssm_remote* remote, ssmTimeT time);
int dssm_ssm_remote_is_newer(struct dssm_ssm_remote* remote, SSM_tid tid);
int dssm_ssm_remote_write(struct dssm_ssm_remote* remote, const void* data, size_t size,
                          ssmTimeT time);

int dssm_ssm_remote_set_property(struct dssm_ssm_remote* remote, const void* data, size_t size);
int dssm_ssm_remote_get_property(struct dssm_ssm_remote* remote, void* data, size_t size);
void dssm_ssm_remote_set_offset(const char* address, ssmTimeT offset);

// Begins to collect the stream's samples in a ring of this process. 0: the stream's own life,
// cycle.
int dssm_ssm_remote_buffer(struct dssm_ssm_remote* remote, ssmTimeT life, ssmTimeT cycle);

// The block that this PC shows to all others; and what they show, one call of `take` per host.
int dssm_ssm_remote_send_broadcast(struct dssm_ssm_remote* remote, const void* data, size_t size);
void dssm_ssm_remote_receive_broadcast(struct dssm_ssm_remote* remote,
                                       void (*take)(const char* address, const char* port,
                                                    const void* data, size_t size, void* user_data),
                                       void* user_data);
}

// The default property and broadcast block: none.
class DSSMDummy {};

typedef enum { TCP_CONNECT, UDP_CONNECT } Connect_type;

class PConnector {
 public:
  SSM_tid timeId;  // of the last sample read; -1 at first
  ssmTimeT time;   // its time; of the last one written; 0 at first

  PConnector() { initPConnector(); }
  // NOLINTNEXTLINE(google-explicit-constructor): as in DSSM
  PConnector(const char* newName, int newId = -1, const char* ipAddress = "127.0.0.1") {
    initPConnector();
    setStream(newName, newId);
    setIpAddress(ipAddress);
  }
  PConnector(const PConnector&) = delete;
  PConnector& operator=(const PConnector&) = delete;
  virtual ~PConnector() { dssm_ssm_remote_delete(mRemote); }

  void initPConnector() {
    mName.clear();
    mAddress = "127.0.0.1";
    streamId = -1;
    timeId = -1;
    time = 0;
    saveTime = cycle = life = 0;
    dsock = -1;
    mData = nullptr;
    mDataSize = 0;
    mProperty = nullptr;
    mPropertySize = 0;
    mFullData = nullptr;
    mFullDataSize = sizeof(ssmTimeT);
    isVerbose = true;
    isBlocking = false;
    mHasDataCon = false;
  }

  // Waits until the dssmd there answers: for $DSSM_CONNECT_TIMEOUT seconds, if that is set, and
  // until a signal handler runs.
  bool initRemote() { return dssm_ssm_remote_connect(remote(), mAddress.c_str()) != 0; }
  bool initDSSM() { return initRemote(); }
  bool initSSM() { return initRemote(); }  // the prototype's name for it

  void setStream(const char* newName, int newId) {
    mName = newName ? newName : "";
    streamId = newId;
  }
  void setBuffer(void* newData, uint64_t newDataSize, void* newProperty, uint64_t newPropertySize,
                 void* newFullData) {
    mData = newData;
    mDataSize = newDataSize;
    mProperty = newProperty;
    mPropertySize = newPropertySize;
    mFullData = newFullData;
    mFullDataSize = newDataSize + sizeof(ssmTimeT);
  }
  void setIpAddress(const char* address) { mAddress = address ? address : "127.0.0.1"; }

  // Creates the stream there, or joins it where it is: false when it cannot, or has another size.
  // 0: as last time.
  bool create(const char* newName, int newId, double newSaveTime, double newCycle) {
    setStream(newName, newId);
    return create(newSaveTime, newCycle);
  }
  bool create(double newSaveTime = 0.0, double newCycle = 0.0) {
    if (newSaveTime > 0 || newSaveTime < 0) saveTime = newSaveTime;
    if (newCycle > 0 || newCycle < 0) cycle = newCycle;
    mHasDataCon = false;
    return hasBuffer("create") &&
           dssm_ssm_remote_create(remote(), mAddress.c_str(), mName.c_str(), streamId,
                                  static_cast<size_t>(mDataSize), saveTime, cycle) != 0;
  }

  // Waits until the stream is there, as long as initRemote() waits; false when it has another size
  // than the data. SSM_READ_BUFFER (and SSM_EXCLUSIVE, in programs between the prototype and
  // DSSM) means that readyRingBuf() follows.
  bool open(SSM_open_mode = SSM_READ) {
    mHasDataCon = false;
    return hasBuffer("open") && dssm_ssm_remote_open(remote(), mAddress.c_str(), mName.c_str(),
                                                     streamId, static_cast<size_t>(mDataSize)) != 0;
  }
  bool open(const char* newName, int newId, SSM_open_mode openMode) {
    setStream(newName, newId);
    return open(openMode);
  }

  // After create() or open().
  bool setProperty() {
    return mPropertySize > 0 && dssm_ssm_remote_set_property(
                                    remote(), mProperty, static_cast<size_t>(mPropertySize)) != 0;
  }
  bool getProperty() {
    return mPropertySize > 0 && dssm_ssm_remote_get_property(
                                    remote(), mProperty, static_cast<size_t>(mPropertySize)) != 0;
  }

  // This PC's SSM clock, when the address is this PC; another one's cannot be set from here.
  void setOffset(ssmTimeT offset) { dssm_ssm_remote_set_offset(mAddress.c_str(), offset); }

  void setConnectType(Connect_type) {}  // both are carried by TCP
  // Whether create() or open() succeeded; reads and writes before it fail.
  bool createDataCon() { return mHasDataCon = isOpen(); }
  bool TCPcreateDataCon() { return createDataCon(); }
  bool UDPcreateDataCon() { return createDataCon(); }

  // Ends it; always true, also twice.
  bool release() {
    if (mRemote) dssm_ssm_remote_close(mRemote);
    return true;
  }
  bool terminate() { return release(); }

  bool isOpen() { return mRemote && dssm_ssm_remote_is_open(mRemote) != 0; }
  const char* getStreamName() const { return mName.c_str(); }
  const char* getSensorName() const {
    std::cerr << "PConnector::getSensorName() : old name, use getStreamName()" << std::endl;
    return getStreamName();
  }
  int getStreamId() const { return streamId; }
  int getSensorId() const {
    std::cerr << "PConnector::getSensorId() : old name, use getStreamId()" << std::endl;
    return getStreamId();
  }
  bool isUpdate() { return mHasDataCon && dssm_ssm_remote_is_newer(remote(), timeId) != 0; }
  void setVerbose(bool verbose) { isVerbose = verbose; }
  void setBlocking(bool blocking) { isBlocking = blocking; }  // no effect, as ever
  SSM_sid getSSMId() { return nullptr; }

  void* getData() { return mData; }
  void* data() { return mData; }
  uint64_t dataSize() { return mDataSize; }
  void* property() { return mProperty; }
  uint64_t propertySize() { return mPropertySize; }
  uint64_t sharedSize() { return mDataSize; }

  // The stream's tids, asked over the network; -1 also before createDataCon().
  SSM_tid getTID_top() { return mHasDataCon ? dssm_ssm_remote_top(remote(), 0) : -1; }
  SSM_tid getTID_top(SSM_sid) { return getTID_top(); }
  SSM_tid getTID_bottom() { return mHasDataCon ? dssm_ssm_remote_bottom(remote()) : -1; }
  SSM_tid getTID_bottom(SSM_sid) { return getTID_bottom(); }
  SSM_tid getTID(SSM_sid, ssmTimeT ytime) {
    return mHasDataCon ? dssm_ssm_remote_tid_at(remote(), ytime) : -1;
  }

  double timettof(struct timespec t) {
    return static_cast<double>(t.tv_sec) + static_cast<double>(t.tv_nsec) * 1e-9;
  }
  static ssmTimeT getRealTime() { return gettimeSSM_real(); }

  // Hands what follows the time in `fulldata` (DSSMApi's *wdata) to the network, and never waits
  // for it. While the other PC is unavailable the newest samples are kept.
  bool write(ssmTimeT writeTime = gettimeSSM()) {
    if (!mHasDataCon || !mFullData) return false;
    const char* const sample = static_cast<const char*>(mFullData) + sizeof(ssmTimeT);
    if (!dssm_ssm_remote_write(remote(), sample, static_cast<size_t>(mDataSize), writeTime)) {
      return false;
    }
    time = writeTime;
    return true;
  }

  // Sample number `readId`, the newest one when negative. A false from any of the reads leaves
  // data, timeId and time as they were.
  bool read(SSM_tid readId = -1, READ_packet_type type = TIME_ID) {
    if (type == REAL_TIME) return readTime(time);
    if (type == READ_NEXT) return readNext(readId);
    return take(0, readId < 0 ? DSSM_SSM_NEWEST : DSSM_SSM_TID, readId, 0, 0);
  }
  // The newest sample, if it is newer than the last one read.
  bool readNew() { return take(0, DSSM_SSM_NEWER, timeId, 0, 0); }
  // The sample `dt` after the last one; the newest at first. When the ring no longer holds it, the
  // oldest it holds.
  bool readNext(int dt = 1) { return take(0, DSSM_SSM_NEXT, timeId, dt, 0); }
  bool readBack(int dt = 1) { return dt <= timeId ? read(timeId - dt) : false; }
  bool readLast() { return read(-1); }
  // The newest sample with a time <= `t`; the newest of all for 0 or less.
  bool readTime(ssmTimeT t) { return take(0, DSSM_SSM_AT, 0, 0, t); }

  virtual void readyRingBuf(ssmTimeT newLife = 0.0, ssmTimeT newCycle = 0.0) {
    if (newLife > 0 || newLife < 0) life = newLife;
    if (newCycle > 0 || newCycle < 0) cycle = newCycle;
    timeId = -1;
    if (isOpen()) dssm_ssm_remote_buffer(remote(), life, cycle);
  }

 protected:
  int streamId;
  double saveTime, cycle, life;
  int dsock;  // no socket of the program's
  void* mData;
  uint64_t mDataSize;
  void* mProperty;
  uint64_t mPropertySize;
  void* mFullData;  // a time, and the sample after it
  uint64_t mFullDataSize;
  bool isVerbose;
  bool isBlocking;

  struct dssm_ssm_remote* remote() {
    if (!mRemote) mRemote = dssm_ssm_remote_new();
    return mRemote;
  }
  bool hasDataCon() const { return mHasDataCon; }

  bool take(int buffered, dssm_ssm_remote_which which, SSM_tid tid, int dt, ssmTimeT t) {
    if (!mHasDataCon || !mData) return false;
    const SSM_tid read = dssm_ssm_remote_read(remote(), buffered, which, tid, dt, t, mData,
                                              static_cast<size_t>(mDataSize), &time);
    if (read < 0) return false;
    timeId = read;
    return true;
  }

 private:
  std::string mName, mAddress;
  bool mHasDataCon;
  struct dssm_ssm_remote* mRemote = nullptr;

  // Samples of size 0 have an address, too.
  bool hasBuffer(const char* function) const {
    if (mData || mDataSize > 0) return true;
    std::cerr << "PConnector::" << function << "() : data buffer of '" << mName
              << "', id = " << streamId << " is not set" << std::endl;
    return false;
  }
};

#endif
