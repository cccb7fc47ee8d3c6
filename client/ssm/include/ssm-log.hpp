// SPDX-License-Identifier: Apache-2.0
//
// Logs of SSM: SSMLog<D, P> reads and writes the log of a stream of D with a property P, and
// SSMLogBase is the part of it that knows no types. Source-compatible with SSM and DSSM, and so is
// the file, byte for byte; docs/ssm.md "Logs". Compiles as C++98 and later.
//
//   copies   a copy shares the open file and the place in it; the file is closed with its last user
//   threads  an object and its copies belong to one thread at a time
//   errors   a line on stderr when a file cannot be opened, created or written
#ifndef DSSM_SSM_LOG_HPP
#define DSSM_SSM_LOG_HPP

#include <cstring>
#include <fstream>
#include <sstream>
#include <string>

#include "ssm.hpp"

extern "C" {
// Between this header and libssm; not for programs.
struct dssm_ssm_log;  // an open file with the number of its users
struct dssm_ssm_log_head {
  const char* stream_name;
  int stream_id;
  int buffer_num;
  size_t data_size;
  size_t property_size;
  double cycle;
  double start_time;
};
// One user; NULL, with a line on stderr, when it fails.
struct dssm_ssm_log* dssm_ssm_log_open(const char* file_name);
struct dssm_ssm_log* dssm_ssm_log_create(const struct dssm_ssm_log_head* head, const void* property,
                                         const char* file_name);
// One user more; NULL for NULL.
struct dssm_ssm_log* dssm_ssm_log_share(struct dssm_ssm_log* log);
// One user less; the last one closes the file. 0 when what was written could not be stored.
int dssm_ssm_log_close(struct dssm_ssm_log* log);
// Valid as long as the log.
const struct dssm_ssm_log_head* dssm_ssm_log_get_head(const struct dssm_ssm_log* log);
// 1, or 0; sizes that are not the file's are refused with a line on stderr.
int dssm_ssm_log_property(struct dssm_ssm_log* log, void* property, size_t size);
int dssm_ssm_log_write(struct dssm_ssm_log* log, double time, const void* data, size_t size);
int dssm_ssm_log_read(struct dssm_ssm_log* log, double* time, void* data, size_t size);
// Moves the place of the next record: 1, or 0 without a move.
int dssm_ssm_log_seek(struct dssm_ssm_log* log, int diff);
int dssm_ssm_log_back(struct dssm_ssm_log* log);  // to the one before the last one read
int dssm_ssm_log_find(struct dssm_ssm_log* log, double time);  // to the newest before `time`
}

class SSMLogBase {
 public:
  SSMLogBase() { init(); }
  SSMLogBase(const SSMLogBase& other) {
    init();
    assign(other);
  }
  SSMLogBase& operator=(const SSMLogBase& other) {
    if (this != &other) assign(other);
    return *this;
  }
  virtual ~SSMLogBase() { dssm_ssm_log_close(mLog); }

  // The buffers of records and property, which stay the caller's. open() takes any log: ask it for
  // its sizes, set buffers, and call readProperty(). Nothing is read into a buffer of another size.
  void setBuffer(void* newData, size_t newDataSize, void* newProperty, size_t newPropertySize) {
    mData = newData;
    mDataSize = mDataCapacity = newDataSize;
    mProperty = newProperty;
    mPropertySize = mPropertyCapacity = newPropertySize;
  }

  // The log's property into the buffer; false when there is none, or it has another size.
  bool readProperty() {
    return mLog && mProperty && mPropertySize > 0 &&
           dssm_ssm_log_property(mLog, mProperty, mPropertyCapacity) != 0;
  }

  // Opens a log for reading, at its first record, and reads its property if the buffer has its
  // size. False when there is no log of that name, or, for an SSMLog, records or property have
  // other sizes than its types. A log without a property leaves the buffer as it is;
  // propertySize() is then 0.
  bool open(const char* fileName) {
    close();
    mLog = dssm_ssm_log_open(fileName);
    if (!mLog) return false;
    const dssm_ssm_log_head& head = *dssm_ssm_log_get_head(mLog);
    mDataSize = head.data_size;
    mPropertySize = mUsesProperty ? head.property_size : 0;
    const bool fits = mPropertySize == mPropertyCapacity;
    if (mIsTyped && mDataSize != mDataCapacity) {
      return refuse(fileName, "bytes per record", mDataSize, mDataCapacity);
    }
    if (mIsTyped && mPropertySize > 0 && !fits) {
      return refuse(fileName, "bytes of property", mPropertySize, mPropertyCapacity);
    }
    if (mProperty && mPropertySize > 0 && fits && !readProperty()) return close() && false;
    mStreamName = head.stream_name;
    mStreamId = head.stream_id;
    mBufferNum = head.buffer_num;
    mCycle = head.cycle;
    mStartTime = mTime = head.start_time;
    return true;
  }

  // Creates a log, or empties the one of that name, and writes the property as it is now.
  bool create(const char* streamName, int streamId, int bufferNum, double cycle,
              const char* fileName, ssmTimeT startTime = gettimeSSM()) {
    close();
    mStreamName = streamName ? streamName : "";
    mStreamId = streamId;
    mBufferNum = bufferNum;
    mCycle = cycle;
    mStartTime = mTime = startTime;
    dssm_ssm_log_head head;
    head.stream_name = mStreamName.c_str();
    head.stream_id = streamId;
    head.buffer_num = bufferNum;
    head.data_size = mDataCapacity;
    head.property_size = mProperty ? mPropertyCapacity : 0;
    head.cycle = cycle;
    head.start_time = startTime;
    mLog = dssm_ssm_log_create(&head, mProperty, fileName);
    return mLog != 0;
  }

  // True also when nothing is open; false when the end of the log could not be stored.
  bool close() {
    dssm_ssm_log* const log = mLog;
    mLog = 0;
    mDataSize = mDataCapacity;
    mPropertySize = mPropertyCapacity;
    return dssm_ssm_log_close(log) != 0;
  }

  // Appends a record. After a failure all later ones fail, so that the log stays readable.
  virtual bool write(ssmTimeT writeTime = gettimeSSM()) {
    if (!mLog || !dssm_ssm_log_write(mLog, writeTime, mData, mDataCapacity)) return false;
    mTime = writeTime;
    return true;
  }

  // The next record; false at the end, and where the buffer has another size. The end moves while
  // the log is being written.
  virtual bool read() { return mLog && dssm_ssm_log_read(mLog, &mTime, mData, mDataCapacity) != 0; }

  // Moves by `diff` records; false, without a move, when there is no such place.
  bool seek(int diff) { return mLog && dssm_ssm_log_seek(mLog, diff) != 0; }

  // The newest record with a time before `readTimeOf`, else the first one. False for an empty log.
  bool readTime(ssmTimeT readTimeOf) {
    return mLog && dssm_ssm_log_find(mLog, readTimeOf) != 0 && read();
  }

  bool readNext() { return read(); }

  // The record before the last one read; false, without a move, at the first. At the end, after a
  // read that failed, the last one.
  bool readBack() { return mLog && dssm_ssm_log_back(mLog) != 0 && read(); }

  const char* getStreamName() const { return mStreamName.c_str(); }
  const ssmTimeT& getStartTime() const { return mStartTime; }
  ssmTimeT& time() { return mTime; }  // of the last record; the start time before the first one
  void* data() { return mData; }
  size_t& dataSize() { return mDataSize; }
  void* property() { return mProperty; }
  size_t& propertySize() { return mPropertySize; }
  const int& getStreamId() const { return mStreamId; }
  const double& getCycle() const { return mCycle; }  // 0: less than half a microsecond
  const int& getBufferNum() const { return mBufferNum; }

 private:
  dssm_ssm_log* mLog;
  std::string mStreamName;
  int mStreamId, mBufferNum;
  double mCycle;
  ssmTimeT mStartTime, mTime;
  void* mData;
  size_t mDataSize, mDataCapacity;  // of the open log; of the buffer
  void* mProperty;
  size_t mPropertySize, mPropertyCapacity;
  bool mIsTyped, mUsesProperty;  // an SSMLog; not one whose type says that it wants no property

  void init() {
    mLog = 0;
    mStreamId = mBufferNum = 0;
    mCycle = mStartTime = mTime = 0;
    setBuffer(0, 0, 0, 0);
    mIsTyped = false;
    mUsesProperty = true;
  }

  void assign(const SSMLogBase& other) {
    dssm_ssm_log* const log = dssm_ssm_log_share(other.mLog);
    dssm_ssm_log_close(mLog);
    mLog = log;
    mStreamName = other.mStreamName;
    mStreamId = other.mStreamId;
    mBufferNum = other.mBufferNum;
    mCycle = other.mCycle;
    mStartTime = other.mStartTime;
    mTime = other.mTime;
    mData = other.mData;
    mDataSize = other.mDataSize;
    mDataCapacity = other.mDataCapacity;
    mProperty = other.mProperty;
    mPropertySize = other.mPropertySize;
    mPropertyCapacity = other.mPropertyCapacity;
    mIsTyped = other.mIsTyped;
    mUsesProperty = other.mUsesProperty;
  }

  bool refuse(const char* fileName, const char* what, size_t inFile, size_t inProgram) {
    std::cerr << "SSM ERROR : open log '" << fileName << "' : it has " << inFile << " " << what
              << ", this program's type " << inProgram
              << " : use the type that it was recorded with" << std::endl;
    close();
    return false;
  }

 protected:
  // For SSMLog, whose buffers are those of this object, not of the one that it is a copy of.
  void setTypedBuffer(void* newData, size_t newDataSize, void* newProperty, size_t newPropertySize,
                      bool usesProperty) {
    const size_t dataInLog = mDataSize, propertyInLog = mPropertySize;
    setBuffer(newData, newDataSize, newProperty, newPropertySize);
    if (mLog) mDataSize = dataInLog, mPropertySize = propertyInLog;
    mIsTyped = true;
    mUsesProperty = usesProperty;
  }
};

// The buffers of SSMLog, in a base of their own so that a copy copies them member by member, arrays
// included.
template <typename D, typename P>
class DSSMSSMLogMembers {
 protected:
  D mLogData;
  P mLogProperty;
};

template <typename P>
struct DSSMSSMIsProperty {
  enum { value = 1 };
};
template <>
struct DSSMSSMIsProperty<SSMDummy> {
  enum { value = 0 };
};

template <typename D, typename P = SSMDummy>
class SSMLog : public SSMLogBase, private DSSMSSMLogMembers<D, P> {
  typedef DSSMSSMLogMembers<D, P> Members;

 public:
  SSMLog() { useOwnMembers(); }
  SSMLog(const SSMLog& other) : SSMLogBase(other), Members(other) { useOwnMembers(); }
  SSMLog& operator=(const SSMLog& other) {
    SSMLogBase::operator=(other);
    Members::operator=(other);
    useOwnMembers();
    return *this;
  }
  virtual ~SSMLog() {}

  D& data() { return this->mLogData; }  // always the same object
  P& property() { return this->mLogProperty; }

 private:
  void useOwnMembers() {
    setTypedBuffer(&this->mLogData, sizeof(D), &this->mLogProperty, sizeof(P),
                   DSSMSSMIsProperty<P>::value != 0);
  }
};

#endif
