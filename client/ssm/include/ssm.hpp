// SPDX-License-Identifier: Apache-2.0
//
// The C++ interface of SSM: SSMApi<T, P> reads and writes a stream of T with a property P, and
// SSMApiBase is the part of it that knows no types. Source-compatible with SSM and DSSM: member
// names, signatures, and which functions are virtual are theirs. What each call returns is in
// docs/ssm.md. Compiles as C++98 and later.
//
//   T        anything: structs, arrays, classes that own memory (with callbacks of their own, see
//            readSSMP). Exactly one T and one P live inside the object.
//   copies   objects may be copied; the copy of an SSMApi uses its own data and property, and
//            shares the open stream
//   signals  close() and release() may be called from a signal handler at any moment
#ifndef DSSM_SSM_HPP
#define DSSM_SSM_HPP

#include <errno.h>
#include <memory.h>

#include <cstring>
#include <iostream>

#include "ssm.h"

extern "C" {
// Between these headers and libssm; not for programs.
// Bytes of one sample of an open stream; (size_t)-1 when `sid` is not open.
size_t dssm_ssm_data_size(SSM_sid sid);
// Waits until the stream exists (1), `timeout` real seconds passed (0; <= 0: no limit), a signal
// handler ran (-1), or dssmd cannot be asked (-2).
int dssm_ssm_wait_stream(const char* stream_name, int stream_id, double timeout);
// As get_propertySSM, but only when the property is exactly `size` bytes; reports on stderr if not.
int dssm_ssm_get_property(const char* stream_name, int stream_id, void* data, size_t size);
// The first of the samples from `tid` on that is not lost. One that is not here yet is an error;
// with `waits` only after a second.
SSM_tid dssm_ssm_next(SSM_sid sid, SSM_tid tid, int waits);
}

// The default property: none.
class SSMDummy {};

class SSMApiBase {
 protected:
  const char* streamName;  // never dangles: names given to the functions here are copied
  int streamId;
  SSM_sid ssmId;
  bool isVerbose;
  bool isBlocking;
  void* mData;
  size_t mDataSize;
  void* mProperty;
  size_t mPropertySize;

  void init() {
    setStream("", 0);
    ssmId = 0;
    isVerbose = true;
    isBlocking = false;
    mData = 0;
    mDataSize = 0;
    mProperty = 0;
    mPropertySize = 0;
    timeId = -1;
    time = 0;
    mCheckedId = 0;
    mCheckedSize = 0;
    mComplainedId = 0;
    mBaseSharedSize = false;
  }

  void init(const char* newName, int newId = 0) {
    init();
    setStream(newName, newId);
  }

  void setStream(const char* newName, int newId = 0) {
    streamId = newId;
    if (!newName) {
      streamName = 0;
      return;
    }
    // Longer names are no stream names; what is kept of them is still too long to become one.
    size_t length = std::strlen(newName);
    if (length > sizeof(mName) - 1) length = sizeof(mName) - 1;
    std::memmove(mName, newName, length);
    mName[length] = '\0';
    streamName = mName;
  }

 public:
  SSM_tid timeId;  // of the last sample read or written; -1 at first
  ssmTimeT time;   // its time; 0 at first

  SSMApiBase() { init(); }
  // Not explicit, as in SSM: NOLINTNEXTLINE(google-explicit-constructor)
  SSMApiBase(const char* newName, int newId = 0) { init(newName, newId); }
  SSMApiBase(const SSMApiBase& other) { assign(other); }
  SSMApiBase& operator=(const SSMApiBase& other) {
    if (this != &other) assign(other);
    return *this;
  }
  virtual ~SSMApiBase() {}  // closes nothing: copies and copied ids go on

  bool isOpen() const { return ssmId != 0; }
  bool isUpdate() { return isOpen() && isNewer(getTID_top(ssmId)); }
  void setVerbose(bool verbose) { isVerbose = verbose; }
  void setBlocking(bool blocking) { isBlocking = blocking; }

  const char* getStreamName() const { return streamName ? streamName : ""; }
  int getStreamId() const { return streamId; }
  const char* getSensorName() const {
    std::cerr << "SSM::getSensorName() : old name, use getStreamName()" << std::endl;
    return getStreamName();
  }
  int getSensorId() const {
    std::cerr << "SSM::getSensorId() : old name, use getStreamId()" << std::endl;
    return getStreamId();
  }
  SSM_sid getSSMId() const { return ssmId; }

  void* data() { return mData; }
  size_t dataSize() { return mDataSize; }
  void* property() { return mProperty; }
  size_t propertySize() { return mPropertySize; }

  // Bytes of one slot, asked by create(). Override it where a callback stores something else than
  // the data buffer.
  virtual size_t sharedSize() {
    mBaseSharedSize = true;
    return dataSize();
  }

  // Creates the stream, or joins it where it is: false when it cannot, or has another size.
  bool create(double saveTime, double cycle) {
    if (!hasBuffer("create")) return false;
    closeSSM(&ssmId);
    ssmId = createSSM(streamName, streamId, sharedSize(), saveTime, cycle);
    if (ssmId != 0) return true;
    if (isVerbose) complain("create", "cannot create");
    return false;
  }
  bool create(const char* newName, int newId, double saveTime, double cycle) {
    setStream(newName, newId);
    return create(saveTime, cycle);
  }

  // The stream lives on; releasing and closing always succeed.
  bool release() { return releaseSSM(&ssmId) != 0; }
  bool close() { return closeSSM(&ssmId) != 0; }

  // False when there is no such stream, or it has another size than the data buffer (asked only
  // where sharedSize() is not overridden; plain reads and writes ask in any case).
  bool open(SSM_open_mode openMode = SSM_READ) {
    if (!hasBuffer("open")) return false;
    if (openQuietly(openMode) && !isForeign()) return true;
    if (ssmId != 0) {
      complainOfSize("open");
      closeSSM(&ssmId);
    }
    if (isVerbose) complain("open", "cannot open");
    return false;
  }
  bool open(const char* newName, int newId = 0, SSM_open_mode openMode = SSM_READ) {
    setStream(newName, newId);
    return open(openMode);
  }

  // Waits until the stream is there, for `timeOut` seconds of real time (<= 0: no limit), or until
  // a signal handler runs.
  bool openWait(ssmTimeT timeOut = 0.0, SSM_open_mode openMode = SSM_READ) {
    if (!hasBuffer("openWait")) return false;
    if (!openQuietly(openMode)) {
      if (isVerbose) complain("openWait", "wait for stream");
      dssm_ssm_wait_stream(streamName, streamId, timeOut);
    }
    return open(openMode);
  }
  bool openWait(const char* newName, int newId = 0, ssmTimeT timeOut = 0.0,
                SSM_open_mode openMode = SSM_READ) {
    setStream(newName, newId);
    return openWait(timeOut, openMode);
  }

  virtual bool write(ssmTimeT writeTime = gettimeSSM()) {
    if (!fits("write")) return false;
    const SSM_tid tid = writeSSM(ssmId, mData, writeTime);
    if (tid < 0) return false;
    timeId = tid;
    time = writeTime;
    return true;
  }

  // Sample number `readId`, the newest one when negative. A false from any of the reads leaves
  // timeId and time as they were, and data of up to 1024 bytes. Longer data are unspecified then,
  // because the writer may have overtaken the read while it copied.
  virtual bool read(SSM_tid readId = -1) {
    if (!fits("read")) return false;
    const SSM_tid tid = readSSM(ssmId, mData, &time, readId);
    if (tid < 0) return false;
    timeId = tid;
    return true;
  }

  // The sample `dt` after the last one; the newest at first. When the ring no longer holds it, the
  // oldest it holds; when it is lost, the next one that is not.
  bool readNext(int dt = 1) {
    if (!isOpen()) return false;
    if (timeId < 0) {
      if (isBlocking && waitTID(ssmId, 0) != 1) return false;
      return read(-1);
    }
    const SSM_tid wanted = after(timeId, dt);
    SSM_tid target = wanted;
    // Again when a fast writer overtakes this thread between asking and reading.
    for (int attempt = 0; attempt < 100; ++attempt) {
      if (isGone(target)) target = getTID_bottom(ssmId);
      target = dssm_ssm_next(ssmId, target, isBlocking);
      if (target < 0) return false;  // not there yet
      if (read(target)) {
        if (target != wanted && isVerbose) {
          std::cerr << "SSM::readNext() : skipping read data  '" << getStreamName()
                    << "', id = " << streamId << " TID: " << wanted << " -> " << target
                    << std::endl;
        }
        return true;
      }
      if (!isGone(target)) return false;
    }
    return false;
  }

  bool readBack(int dt = 1) { return dt <= timeId ? read(timeId - dt) : false; }

  bool readLast() { return read(-1); }

  // The newest sample, if it is newer than the last one read.
  bool readNew() {
    if (!isOpen()) return false;
    if (isBlocking && waitTID(ssmId, after(timeId, 1)) != 1) return false;
    return isUpdate() && read(-1);
  }

  // The newest sample with a time <= `readTimeOf`; the newest of all for 0 or less.
  virtual bool readTime(ssmTimeT readTimeOf) {
    if (!fits("readTime")) return false;
    const SSM_tid tid = readSSM_time(ssmId, mData, readTimeOf, &time);
    if (tid < 0) return false;
    timeId = tid;
    return true;
  }

  // The stream's property; needs no open().
  bool setProperty() {
    return mPropertySize > 0 &&
           set_propertySSM(streamName, streamId, mProperty, mPropertySize) != 0;
  }
  bool getProperty() {
    return mPropertySize > 0 &&
           dssm_ssm_get_property(streamName, streamId, mProperty, mPropertySize) != 0;
  }

  void setBuffer(void* newData, size_t newDataSize, void* newProperty, size_t newPropertySize) {
    setDataBuffer(newData, newDataSize);
    setPropertyBuffer(newProperty, newPropertySize);
  }
  void setDataBuffer(void* newData, uint64_t newDataSize) {
    mData = newData;
    mDataSize = static_cast<size_t>(newDataSize);
  }
  void setPropertyBuffer(void* newProperty, uint64_t newPropertySize) {
    mProperty = newProperty;
    mPropertySize = static_cast<size_t>(newPropertySize);
  }

  // DSSM's neighbour list and the prototype's debugging aid: kept to compile.
  void addInfo(const char* infoData, uint32_t infoLength, uint16_t port) {
    add_info(infoData, infoLength, port);
  }
  void getInfo() {}
  void showRawData() {
    static const char digits[] = "0123456789abcdef";
    const unsigned char* bytes = static_cast<const unsigned char*>(mData);
    for (size_t i = 0; i < mDataSize; ++i) {
      std::cout << digits[bytes[i] >> 4] << digits[bytes[i] & 15] << ' ';
    }
    std::cout << std::endl;
  }

 private:
  char mName[64];         // streamName points here
  SSM_sid mCheckedId;     // open stream whose size was found to be mCheckedSize
  size_t mCheckedSize;    //
  SSM_sid mComplainedId;  // open stream of whose size a message was printed
  bool mBaseSharedSize;   // the base's sharedSize() ran

  void assign(const SSMApiBase& other) {
    if (other.streamName == other.mName) {
      setStream(other.mName, other.streamId);
    } else {
      streamName = other.streamName;
      streamId = other.streamId;
      mName[0] = '\0';
    }
    ssmId = other.ssmId;
    isVerbose = other.isVerbose;
    isBlocking = other.isBlocking;
    mData = other.mData;
    mDataSize = other.mDataSize;
    mProperty = other.mProperty;
    mPropertySize = other.mPropertySize;
    timeId = other.timeId;
    time = other.time;
    mCheckedId = 0;
    mCheckedSize = 0;
    mComplainedId = 0;
    mBaseSharedSize = false;
  }

  // Tids are 31 bits of a counter without end: after 2147483647 comes 0 again, so "newer"
  // is a question of distance, not of size.
  static SSM_tid after(SSM_tid tid, int dt) {
    if (tid >= 0 && dt > 0 && tid > 0x7fffffff - dt) return tid - 0x7fffffff - 1 + dt;
    return tid + dt;
  }
  static bool isBefore(SSM_tid a, SSM_tid b) {
    return a < 0 ||
           ((static_cast<uint32_t>(b) - static_cast<uint32_t>(a) - 1U) & 0x7fffffffU) < 0x40000000U;
  }
  bool isGone(SSM_tid tid) const {  // older than the oldest
    const SSM_tid bottom = getTID_bottom(ssmId);
    return bottom >= 0 && isBefore(tid, bottom);
  }
  bool isNewer(SSM_tid top) const { return top >= 0 && (timeId < 0 || isBefore(timeId, top)); }

  // Samples of size 0 have an address, too; a program that copies samples itself may set a size
  // alone.
  bool hasBuffer(const char* function) const {
    if (mData != 0 || mDataSize > 0) return true;
    std::cerr << "SSM::" << function << "() : data buffer of '" << getStreamName()
              << "', id = " << streamId << " is not set" << std::endl;
    return false;
  }

  void complain(const char* function, const char* what) const {
    std::cerr << "SSM::" << function << "() : " << what << " '" << getStreamName()
              << "', id = " << streamId << std::endl;
  }

  bool openQuietly(SSM_open_mode openMode) {
    closeSSM(&ssmId);
    ssmId = openSSM(streamName, streamId, static_cast<char>(openMode));
    return ssmId != 0;
  }

  // Whether the open stream surely is not one of this object's type: sharedSize() is the base's, so
  // that reads and writes will copy the data buffer.
  bool isForeign() {
    mBaseSharedSize = false;
    const size_t size = sharedSize();
    return mBaseSharedSize && size == mDataSize && dssm_ssm_data_size(ssmId) != mDataSize;
  }

  void complainOfSize(const char* function) {
    std::cerr << "SSM::" << function << "() : '" << getStreamName() << "', id = " << streamId
              << " has " << dssm_ssm_data_size(ssmId) << " bytes per sample, this program's type "
              << mDataSize << " : use the type that the stream was created with" << std::endl;
  }

  // Whether samples of the open stream are exactly as long as the data buffer. Ids are never used
  // twice, so each is asked once.
  bool fits(const char* function) {
    const SSM_sid sid = ssmId;  // a signal handler may close it meanwhile
    if (sid == 0) return false;
    if (sid == mCheckedId && mCheckedSize == mDataSize) return true;
    const size_t size = dssm_ssm_data_size(sid);
    if (size == static_cast<size_t>(-1)) return false;
    if (size == mDataSize) {
      mCheckedId = sid;
      mCheckedSize = size;
      return true;
    }
    if (mComplainedId != sid) complainOfSize(function);
    mComplainedId = sid;
    return false;
  }
};

// The data members of SSMApi, in a base of their own so that a copy of an SSMApi copies them member
// by member, arrays included.
template <typename T, typename P>
class DSSMSSMApiMembers {
 public:
  T data;
  P property;
};

template <typename T, typename P = SSMDummy>
class SSMApi : public SSMApiBase, public DSSMSSMApiMembers<T, P> {
  typedef DSSMSSMApiMembers<T, P> Members;

 public:
  using Members::data;      // T data
  using Members::property;  // P property

  SSMApi() { useOwnMembers(); }
  // Not explicit, as in SSM: NOLINTNEXTLINE(google-explicit-constructor)
  SSMApi(const char* newName, int newId = 0) : SSMApiBase(newName, newId) { useOwnMembers(); }
  SSMApi(const SSMApi& other) : SSMApiBase(other), Members(other) { useOwnMembers(); }
  SSMApi& operator=(const SSMApi& other) {
    SSMApiBase::operator=(other);
    Members::operator=(other);
    useOwnMembers();
    return *this;
  }
  ~SSMApi() {}

 protected:
  // Never defined: an SSMApi has its buffers.
  void setBuffer(void* newData, size_t newDataSize, void* newProperty, size_t newPropertySize);

 private:
  void useOwnMembers() {
    SSMApiBase::setBuffer(&this->data, sizeof(T), &this->property, sizeof(P));
  }
};

#endif
