// SPDX-License-Identifier: Apache-2.0
//
// Logs: the bytes of the file, what each call of SSMLog returns, and files that are not what they
// say. Logs are built here by hand, from the description of the format.
#include <errno.h>
#include <sys/stat.h>

#include <fstream>
#include <limits>
#include <list>
#include <ssm-log.hpp>
#include <sstream>
#include <string>
#include <vector>

#include "check.h"

namespace {

struct Odometry {
  double x, y;
};

typedef unsigned char Image[300];

const double kInfinity = std::numeric_limits<double>::infinity();

std::string path(const char* name) { return std::string(check_folder) + "/" + name; }

template <class T>
std::string bytes_of(const T& value) {
  return std::string(reinterpret_cast<const char*>(&value), sizeof(T));
}

std::string record(double time, double x, double y) {
  return bytes_of(time) + bytes_of(x) + bytes_of(y);
}

void save(const std::string& file, const std::string& bytes) {
  std::ofstream out(file.c_str(), std::ios::binary);
  out << bytes;
}

std::string load(const std::string& file) {
  std::ifstream in(file.c_str(), std::ios::binary);
  std::ostringstream bytes;
  bytes << in.rdbuf();
  return bytes.str();
}

// A log of records with these times and x = 0, 1, 2...
std::string log_of(const std::vector<double>& times) {
  std::string log = "odo 2 16 49 0.000000 1795250129.792010 4\n" + bytes_of(-7);
  for (unsigned i = 0; i < times.size(); ++i) log += record(times[i], i, 0.5);
  return log;
}

// 117 bytes, as the old library wrote them.
void the_file_has_the_old_bytes() {
  std::vector<double> times;
  times.push_back(1795250130.25);
  times.push_back(1795250130.5);
  times.push_back(1795250129.0);  // any order
  const std::string expected = log_of(times);
  CHECK_EQUAL(expected.size(), 117);

  SSMLog<Odometry, int> log;
  log.property() = -7;
  CHECK(log.create("odo", 2, 49, 1e-7, path("new.log").c_str(), 1795250129.79201));
  for (unsigned i = 0; i < times.size(); ++i) {
    log.data().x = i;
    log.data().y = 0.5;
    CHECK(log.write(times[i]));
    CHECK_SAME(log.time(), times[i]);
  }
  CHECK(log.close());
  CHECK(load(path("new.log")) == expected);

  save(path("old.log"), expected);
  SSMLog<Odometry, int> read;
  Odometry* const data = &read.data();
  CHECK(read.open(path("old.log").c_str()));
  CHECK_EQUAL(read.property(), -7);
  CHECK(std::string(read.getStreamName()) == "odo");
  CHECK_EQUAL(read.getStreamId(), 2);
  CHECK_EQUAL(read.getBufferNum(), 49);
  CHECK_EQUAL(read.dataSize(), 16);
  CHECK_EQUAL(read.propertySize(), 4);
  CHECK_SAME(read.getCycle(), 0);
  CHECK_SAME(read.getStartTime(), 1795250129.79201);
  CHECK_SAME(read.time(), 1795250129.79201);  // until the first read
  for (unsigned i = 0; i < times.size(); ++i) {
    CHECK(read.readNext());
    CHECK(&read.data() == data);
    CHECK_SAME(data->x, i);
    CHECK_SAME(read.time(), times[i]);
  }
  CHECK(!read.read());
  CHECK(read.close() && read.close());
  CHECK(!read.read() && !read.seek(0) && !read.readTime(1) && !read.readBack() && !read.write(1));

  // A type without a property has one byte of it, as before.
  SSMLog<Image> image;
  CHECK(image.create("image", 0, 7, 0.1, path("image.log").c_str(), 5));
  CHECK(image.write(6) && image.close());
  CHECK(load(path("image.log")).compare(0, 33, "image 0 300 7 0.100000 5.000000 1\n", 33) == 0);
  CHECK_EQUAL(load(path("image.log")).size(), 34 + 1 + 308);
}

void records_are_found_by_their_number() {
  std::vector<double> times;
  for (int i = 0; i < 10; ++i) times.push_back(100 + i);
  save(path("ten.log"), log_of(times) + "part of a record");
  SSMLog<Odometry, int> log;
  CHECK(log.open(path("ten.log").c_str()));
  CHECK(!log.readBack());
  CHECK(log.readNext() && log.time() == 100);  // the failed one has not moved it
  CHECK(!log.readBack());
  CHECK(log.readNext() && log.readNext() && log.time() == 102);
  CHECK(log.readBack() && log.time() == 101);
  CHECK(log.seek(3) && log.read() && log.time() == 105);
  CHECK(!log.seek(5) && !log.seek(-7));
  CHECK(log.readNext() && log.time() == 106);
  CHECK(log.seek(-7) && log.read() && log.time() == 100);
  CHECK(log.seek(9));  // the end itself is a place
  CHECK(!log.read());
  CHECK_SAME(log.time(), 100);
  CHECK(log.readBack() && log.time() == 109);  // after a failed read the last one again
  CHECK(log.readBack() && log.time() == 108);
}

// The newest record before `time`, else the first one.
unsigned expected_at(const std::vector<double>& times, double time) {
  for (size_t i = times.size(); i-- > 0;) {
    if (times[i] < time) return static_cast<unsigned>(i);
  }
  return 0;
}

void records_are_found_by_time() {
  const double kNoTimes[] = {kInfinity, -kInfinity, std::numeric_limits<double>::quiet_NaN()};
  const unsigned seed = static_cast<unsigned>(getpid());
  srand(seed);
  printf("seed %u\n", seed);
  for (int round = 0; round < 40; ++round) {
    std::vector<double> times;
    double time = 1000;
    const int count = 1 + rand() % 200, falls = round % 4;  // 0: times never fall
    for (int i = 0; i < count; ++i) {
      time += rand() % 4;
      if (falls && rand() % (20 * falls) == 0) time -= rand() % 50;
      times.push_back(time);
      if (round % 2 && rand() % 20 == 0) times.back() = kNoTimes[rand() % 3];
    }
    save(path("times.log"), log_of(times));
    SSMLog<Odometry, int> log;
    CHECK(log.open(path("times.log").c_str()));
    for (double t = 940; t < 1700; t += 0.5) {
      CHECK(log.readTime(t));
      CHECK_EQUAL(static_cast<long>(log.data().x), expected_at(times, t));
    }
    CHECK(log.readTime(-kInfinity) && log.data().x < 1);
    CHECK(log.readTime(kInfinity));
    CHECK_EQUAL(static_cast<long>(log.data().x), count - 1);
    // A log that is being written is found as far as it has come.
    save(path("times.log"), log_of(times) + record(5000, count, 0.5));
    CHECK(log.readTime(6000) && log.time() == 5000);
    CHECK(!log.readNext());
  }
  save(path("empty.log"), log_of(std::vector<double>()));
  SSMLog<Odometry, int> log;
  CHECK(log.open(path("empty.log").c_str()));
  CHECK(!log.readTime(5) && !log.read() && !log.readBack());
}

// With the old one, offsets were ints.
void logs_may_be_long() {
  const size_t data = 1 << 20, records = 2200;  // 2.3 GB
  const std::string head = "long 0 1048576 9 0.100000 0.000000 0\n";
  save(path("long.log"), head);
  const int fd = open(path("long.log").c_str(), O_RDWR);
  for (size_t i = 0; i < records; ++i) {
    const double time = 0.5 * static_cast<double>(i);
    const size_t at = head.size() + i * (data + 8);
    CHECK_EQUAL(pwrite(fd, &time, 8, static_cast<off_t>(at)), 8);
  }
  CHECK(ftruncate(fd, static_cast<off_t>(head.size() + records * (data + 8))) == 0);
  close(fd);
  std::vector<char> buffer(data);
  SSMLogBase log;
  CHECK(log.open(path("long.log").c_str()));
  log.setBuffer(&buffer[0], buffer.size(), NULL, 0);
  CHECK(log.readTime(1099.25) && log.time() == 1099);
  CHECK(log.readNext() && log.time() == 1099.5);
  CHECK(!log.readNext());
  CHECK(log.readBack() && log.readBack() && log.time() == 1099);
  CHECK(log.seek(-2100) && log.seek(2100) && log.read() && log.time() == 1099.5);
  CHECK(unlink(path("long.log").c_str()) == 0);
}

// Once, a log of another type was read over the end of the program's.
void sizes_in_a_file_are_not_trusted() {
  struct Guarded {
    SSMLog<int, int> log;
    char guard[64];
  };
  static Guarded guarded;
  memset(guarded.guard, 0x55, sizeof(guarded.guard));
  const char* const heads[] = {"odo 2 64 49 0.05 1.0 4\n", "odo 2 2 49 0.05 1.0 4\n",
                               "odo 2 4 49 0.05 1.0 64\n", "odo 2 4 49 0.05 1.0 2\n"};
  for (unsigned i = 0; i < 4; ++i) {
    save(path("foreign.log"), heads[i] + std::string(500, '\xff'));
    catch_stderr();
    CHECK(!guarded.log.open(path("foreign.log").c_str()));
    CHECK(!guarded.log.read());
    CHECK_TEXT(caught_stderr(), "foreign.log");
  }
  for (unsigned i = 0; i < sizeof(guarded.guard); ++i) CHECK(guarded.guard[i] == 0x55);
  // Without a property in the log, the program's stays; without one in the program, the log's does
  // not matter.
  guarded.log.property() = 9;
  save(path("foreign.log"), "odo 2 4 49 0.05 1.0 0\n" + bytes_of(1.0) + bytes_of(77));
  CHECK(guarded.log.open(path("foreign.log").c_str()));
  CHECK(guarded.log.read() && guarded.log.data() == 77 && guarded.log.property() == 9);
  CHECK_EQUAL(guarded.log.propertySize(), 0);
  SSMLog<int> without;
  save(path("foreign.log"),
       "odo 2 4 49 0.05 1.0 32\n" + std::string(32, 'p') + bytes_of(1.0) + bytes_of(78));
  CHECK(without.open(path("foreign.log").c_str()));
  CHECK(without.read() && without.data() == 78);
  CHECK_EQUAL(without.propertySize(), 0);

  // Without buffers any log can be opened; then they must have its sizes.
  SSMLogBase base;
  char data[4], property[32];
  CHECK(base.open(path("foreign.log").c_str()));
  CHECK_EQUAL(base.dataSize(), 4);
  CHECK_EQUAL(base.propertySize(), 32);
  CHECK(!base.readProperty());
  catch_stderr();
  CHECK(!base.read());
  base.setBuffer(data, 3, property, 31);
  CHECK(!base.read() && !base.readProperty());
  CHECK_TEXT(caught_stderr(), "4 bytes");
  base.setBuffer(data, 4, property, 32);
  CHECK(base.readProperty() && property[31] == 'p');
  // The same object for a log of other sizes: it asks again.
  save(path("other.log"), "odo 2 8 49 0.05 1.0 3\nppp" + bytes_of(1.0) + bytes_of(2.0));
  CHECK(base.open(path("other.log").c_str()));
  CHECK_EQUAL(base.dataSize(), 8);
  CHECK_EQUAL(base.propertySize(), 3);
  catch_stderr();
  CHECK(!base.read() && !base.readProperty());
  CHECK_TEXT(caught_stderr(), "8 bytes");
  CHECK(base.open(path("foreign.log").c_str()));  // with buffers of its sizes, from before
  CHECK(base.read() && memcmp(data, bytes_of(78).data(), 4) == 0);
}

void what_is_no_log_is_refused() {
  const char* const heads[] = {"",
                               "\n",
                               "odo 2 16 49 0.05 1.0 4",
                               "odo 2 16 49 0.05 1.0\n",
                               "odo 2 16 49 0.05 1.0 4 5\n",
                               "odo two 16 49 0.05 1.0 4\n",
                               "odo 2 -16 49 0.05 1.0 4\n",
                               "odo 2 16 49 nan 1.0 4\n",
                               "odo 2 16 49 0.05 inf 4\n",
                               "odo 2 99999999999999999999 4 1 1 4\n",
                               "odo 2 18446744073709551615 49 0.05 1.0 4\n",
                               "odo 2 16 49 0.05 1.0 600\n"};  // more than there is
  for (unsigned i = 0; i < sizeof(heads) / sizeof(heads[0]); ++i) {
    save(path("no.log"), heads[i] + std::string(i > 3 ? 500 : 0, 'x'));
    SSMLogBase log;
    catch_stderr();
    CHECK(!log.open(path("no.log").c_str()));
    CHECK_TEXT(caught_stderr(), "is NOT ssm-log file");
  }
  SSMLogBase log;
  catch_stderr();
  CHECK(!log.open(path("missing.log").c_str()));
  CHECK_TEXT(caught_stderr(), "cannot open log file");
  catch_stderr();
  CHECK(!log.create("odo", 2, 49, 0.1, path("missing/odo.log").c_str(), 1));
  CHECK(!log.create("o do", 2, 49, 0.1, path("odo.log").c_str(), 1));  // would not be read again
  CHECK(!log.create("", 2, 49, 0.1, path("odo.log").c_str(), 1));
  CHECK_TEXT(caught_stderr(), "cannot create log file");
  // Any blanks between the fields.
  save(path("blanks.log"), "  odo \t 2 16\r 49  0.05 1e3 4 \r\n" + bytes_of(3) + record(7, 1, 2));
  SSMLog<Odometry, int> blanks;
  CHECK(blanks.open(path("blanks.log").c_str()));
  CHECK(blanks.read() && blanks.time() == 7 && blanks.property() == 3);
  CHECK_SAME(blanks.getStartTime(), 1000);
}

void a_full_disk_is_reported() {
  SSMLog<Image> log;
  CHECK(log.create("image", 0, 7, 0.1, "/dev/full", 5));
  catch_stderr();
  int written = 0;
  while (written < 100000 && log.write(6)) ++written;
  CHECK(!log.write(7));
  CHECK(!log.close());
  CHECK(written < 100000);
  CHECK_TEXT(caught_stderr(), strerror(ENOSPC));
  // Also when only the end of a short log does not fit.
  CHECK(log.create("image", 0, 7, 0.1, "/dev/full", 5));
  CHECK(log.write(6));
  catch_stderr();
  CHECK(!log.close());
  CHECK_TEXT(caught_stderr(), strerror(ENOSPC));
}

// Programs keep players in lists, and copy them before they open their logs.
void logs_can_be_copied() {
  std::vector<double> times;
  for (int i = 0; i < 5; ++i) times.push_back(i);
  save(path("five.log"), log_of(times));
  std::list<SSMLog<Odometry, int> > logs;
  for (int i = 0; i < 3; ++i) logs.push_back(SSMLog<Odometry, int>());
  for (std::list<SSMLog<Odometry, int> >::iterator log = logs.begin(); log != logs.end(); ++log) {
    CHECK(log->open(path("five.log").c_str()));
    CHECK(log->read() && log->time() == 0);
  }
  SSMLog<Odometry, int> copy(logs.front()), other;
  other = copy;
  logs.clear();
  CHECK(copy.read());
  CHECK_SAME(copy.data().x, 1);
  CHECK(other.read());  // at the place of the one that it is a copy of
  CHECK_SAME(other.data().x, 2);
  CHECK_SAME(copy.data().x, 1);
  CHECK(copy.close() && other.read());
  SSMLog<Image> image, images;
  image.data()[299] = 7;
  images = image;
  CHECK_EQUAL(images.data()[299], 7);
  // What was written is there when the object goes.
  {
    SSMLog<int> log;
    CHECK(log.create("int", 0, 7, 0.1, path("int.log").c_str(), 5));
    CHECK(log.write(6));
  }
  SSMLog<int> log;
  CHECK(log.open(path("int.log").c_str()) && log.read());
}

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  the_file_has_the_old_bytes();
  records_are_found_by_their_number();
  records_are_found_by_time();
  logs_may_be_long();
  sizes_in_a_file_are_not_trusted();
  what_is_no_log_is_refused();
  a_full_disk_is_reported();
  logs_can_be_copied();
  return check_result();
}
