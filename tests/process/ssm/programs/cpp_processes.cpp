// SPDX-License-Identifier: Apache-2.0
//
// Several processes: fork, restarted writers, writers killed inside a write, waiting for each
// other; and what a process holds after many opens and closes.
#include <dirent.h>
#include <libssm.h>
#include <signal.h>
#include <sys/wait.h>

#include <fstream>
#include <ssm.hpp>
#include <string>

#include "check.h"

namespace {

struct Sample {
  int n;
  char fill[60];
};

// The exit status of `body` in a forked child; 99 when it did not exit by itself.
int in_child(int (*body)()) {
  fflush(stdout);
  const pid_t pid = fork();
  if (pid == 0) {
    alarm(60);
    _exit(body());
  }
  int status = 0;
  waitpid(pid, &status, 0);
  return WIFEXITED(status) ? WEXITSTATUS(status) : 99;
}

SSMApi<Sample> forked("forked", 0);

int forked_child() {
  Sample sample;
  ssmTimeT time = 0;
  // What was inherited can be read and written; asking the coordinator needs initSSM.
  if (readSSM(forked.getSSMId(), &sample, &time, -1) != 0 || sample.n != 41) return 1;
  if (getSSM_num() != -1) return 2;
  if (gettimeSSM() < 1e6) return 3;  // still the shared clock, which stands at about 2e6
  if (initSSM() != 1) return 4;
  if (getSSM_node_num() != 2) return 5;
  SSMApi<Sample> own("forked", 0);
  if (!own.open(SSM_WRITE) || !own.readLast() || own.data.n != 41) return 6;
  if (gettimeSSM() > 1e7) return 7;
  own.data.n = 42;
  if (!own.write(2.0) || own.timeId != 1) return 8;
  forked.data.n = 43;
  if (!forked.write(3.0) || forked.timeId != 2) return 9;
  forked.close();
  own.close();
  for (int i = 0; i < 50; ++i) {
    if (!own.open() || !own.readLast() || !own.close()) return 10;
  }
  if (endSSM() != 1) return 11;
  return gettimeSSM() > 1e7 ? 0 : 12;
}

void fork_and_init_again() {
  CHECK_EQUAL(initSSM(), 1);
  CHECK(settimeSSM(2e6) == 1);
  CHECK(forked.create(1.0, 0.1));
  forked.data.n = 41;
  forked.write(1.0);
  CHECK_EQUAL(in_child(forked_child), 0);
  CHECK(forked.readLast() && forked.timeId == 2 && forked.data.n == 43);
  CHECK(forked.write(4.0) && forked.timeId == 3);
  CHECK(getSSM_num() > 0);
  while (getSSM_node_num() != 1) usleep(1000);
  inittimeSSM();
  forked.close();
}

int restarted_writer() {
  SSMApi<Sample> writer("restarted", 0);
  if (!initSSM() || !writer.create(2.0, 0.1)) return 1;
  for (int i = 0; i < 10; ++i) {
    writer.data.n = i;
    if (!writer.write(1.0 + i)) return 2;
  }
  return 0;  // without release or endSSM, as a crash would
}

void writers_come_and_go() {
  SSMApi<Sample> reader("restarted", 0);
  for (int i = 0; i < 3; ++i) {
    CHECK_EQUAL(in_child(restarted_writer), 0);
    CHECK(reader.isOpen() || reader.open());
    CHECK_EQUAL(getTID_top(reader.getSSMId()), 10 * i + 9);
    CHECK(reader.readLast() && reader.data.n == 9);
  }
  reader.close();
}

void die(void*, const void*, void*) { kill(getpid(), SIGKILL); }

int killed_writer() {
  SSMApi<Sample> writer("killed", 0);
  if (!initSSM() || !writer.create(1.0, 0.1)) return 1;
  writeSSMP(writer.getSSMId(), &writer.data, 1.0, die, NULL);
  return 2;
}

void a_killed_writer_blocks_nobody() {
  SSMApi<Sample> writer("killed", 0);
  CHECK(writer.create(1.0, 0.1) && writer.write(1.0));
  for (int i = 0; i < 20; ++i) {
    CHECK_EQUAL(in_child(killed_writer), 99);
    CHECK(writer.write(2.0 + i));
    CHECK_EQUAL(writer.timeId, i + 1);
    CHECK(writer.readLast() && writer.timeId == i + 1);
  }
  writer.release();
}

int late_writer() {
  SSMApi<Sample> writer("late", 0);
  if (!initSSM()) return 1;
  usleep(50000);  // the other one is most likely waiting; right either way
  if (!writer.create(1.0, 0.1)) return 2;
  usleep(50000);
  writer.data.n = 5;
  return writer.write(1.0) ? 0 : 3;
}

void waiting_for_each_other() {
  fflush(stdout);
  const pid_t pid = fork();
  if (pid == 0) _exit(late_writer());
  SSMApi<Sample> reader("late", 0);
  catch_stderr();
  const bool there = reader.openWait(0.0);
  caught_stderr();
  CHECK(there);
  reader.setBlocking(true);
  while (!reader.readNext()) continue;
  CHECK(reader.timeId == 0 && reader.data.n == 5);
  int status = 0;
  waitpid(pid, &status, 0);
  CHECK_EQUAL(status, 0);
  reader.close();
}

struct Frame {
  int numbers[16384];
};

int racing_writer() {
  static SSMApi<Frame> writer("torn", 0);
  if (!initSSM() || !writer.create(0.1, 0.1)) return 1;
  for (int n = 0;; ++n) {
    for (int i = 0; i < 16384; ++i) writer.data.numbers[i] = n;
    if (!writer.write(n)) return 2;
  }
}

void check_whole(const Frame& frame, int tid, ssmTimeT time) {
  bool whole = true;
  for (int i = 0; i < 16384; ++i) whole = whole && frame.numbers[i] == tid;
  CHECK(whole);
  CHECK_SAME(time, tid);
}

// Two slots, 64 KB, a writer at full speed: the worst case for mixtures of two samples.
void no_torn_reads() {
  fflush(stdout);
  const pid_t pid = fork();
  if (pid == 0) _exit(racing_writer());
  static SSMApi<Frame> reader("torn", 0), untouched("torn", 0);
  reader.setVerbose(false);
  CHECK(reader.openWait() && untouched.openWait());
  int good = 0;
  while (good < 2000) {
    if (!reader.readLast()) continue;
    ++good;
    check_whole(reader.data, reader.timeId, reader.time);
    untouched.timeId = reader.timeId;
    const ssmTimeT time = untouched.time;
    if (untouched.read(reader.timeId)) {  // as likely as not overtaken while it copies
      check_whole(untouched.data, untouched.timeId, untouched.time);
    } else {  // its data may be of several samples
      CHECK_SAME(untouched.time, time);
      CHECK_EQUAL(untouched.timeId, reader.timeId);
    }
  }
  kill(pid, SIGKILL);
  waitpid(pid, NULL, 0);
  reader.close();
  untouched.close();
}

int edge_child() {
  SSMApi<Sample> reader("edgy", 7);
  if (!initSSM() || !reader.open()) return 1;
  char name[SSM_SNAME_MAX];
  int id, from, to, mode;
  for (int i = 0; getSSM_edge_info(i, name, sizeof(name), &id, &from, &to, &mode); ++i) {
    if (strcmp(name, "edgy") == 0) {
      return id == 7 && from == getppid() && to == getpid() && mode == SSM_READ ? 0 : 2;
    }
  }
  return 3;
}

void edges_between_processes() {
  SSMApi<Sample> writer("edgy", 7);
  CHECK(writer.create(1.0, 0.1));
  CHECK_EQUAL(in_child(edge_child), 0);
  while (getSSM_edge_num() != 0) usleep(1000);  // a process that is gone leaves no edge
  CHECK_EQUAL(getSSM_node_num(), 1);
  writer.release();
}

// Where the first edge of "edgy" comes from; 0: there is none.
int source_of_edgy() {
  char name[SSM_SNAME_MAX];
  int from;
  for (int i = 0; getSSM_edge_info(i, name, sizeof(name), NULL, &from, NULL, NULL); ++i) {
    if (strcmp(name, "edgy") == 0) return from;
  }
  return 0;
}

int creator_with_heir(int (&created)[2], int (&end)[2]) {
  SSMApi<Sample> writer("edgy", 8);
  char byte = 0;
  if (!initSSM() || !writer.create(1.0, 0.1) || write(created[1], "c", 1) != 1) return 1;
  close(end[1]);
  if (read(end[0], &byte, 1) != 0) return 2;  // until the parent closes it
  return 0;
}

// The edge of a stream is that of its creator, then that of the process that goes on writing it.
void edges_outlive_the_creator() {
  int created[2], end[2];
  if (pipe(created) != 0 || pipe(end) != 0) abort();
  fflush(stdout);
  const pid_t creator = fork();
  if (creator == 0) _exit(creator_with_heir(created, end));
  char byte = 0;
  CHECK_EQUAL(read(created[0], &byte, 1), 1);
  SSMApi<Sample> reader("edgy", 8), heir("edgy", 8);
  CHECK(reader.open());
  CHECK_EQUAL(source_of_edgy(), creator);
  CHECK(heir.create(1.0, 0.1));
  CHECK_EQUAL(source_of_edgy(), creator);
  close(end[0]);
  close(end[1]);
  int status = 0;
  waitpid(creator, &status, 0);
  CHECK_EQUAL(status, 0);
  while (getSSM_node_num() != 1) usleep(1000);
  CHECK_EQUAL(source_of_edgy(), getpid());
  heir.release();
  while (source_of_edgy() != 0) usleep(1000);  // nobody writes it any more
  reader.close();
}

int lines_with(const char* word) {
  std::ifstream maps("/proc/self/maps");
  std::string line;
  int count = 0;
  while (std::getline(maps, line)) count += line.find(word) != std::string::npos;
  return count;
}

int descriptors() {
  DIR* dir = opendir("/proc/self/fd");
  int count = 0;
  while (readdir(dir)) ++count;
  closedir(dir);
  return count;
}

void cycles(int rounds) {
  SSMApi<Sample> writer("cycles", 0), reader("cycles", 0);
  CHECK(writer.create(1.0, 0.1) && reader.open());
  const int top = getTID_top(writer.getSSMId());
  const int maps = lines_with(""), fds = descriptors();
  SSMApi<Sample> again("cycles", 0);
  for (int i = 0; i < rounds; ++i) {
    if (!(i % 2 ? again.create(1.0, 0.1) : again.open()) || !again.write(1.0) ||
        !again.readLast() || !(i % 2 ? again.release() : again.close())) {
      CHECK_EQUAL(i, -1);
      break;
    }
  }
  // What was closed goes soon afterwards, not inside close(): wait for it.
  while (descriptors() > fds) usleep(1000);
  while (lines_with("") > maps + 8) usleep(1000);  // the allocator may have taken some arenas
  CHECK_EQUAL(getTID_top(writer.getSSMId()), top + rounds);
  while (getSSM_edge_num() != 1) usleep(1000);
  writer.release();
  reader.close();
  while (descriptors() >= fds) usleep(1000);  // the last ones let the ring itself go
}

void scripts_find_the_process() { CHECK(lines_with("libssm.so") > 0); }

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  fork_and_init_again();
  writers_come_and_go();
  a_killed_writer_blocks_nobody();
  waiting_for_each_other();
  no_torn_reads();
  edges_between_processes();
  edges_outlive_the_creator();
  cycles(100);
  cycles(10000);
  scripts_find_the_process();
  CHECK_EQUAL(endSSM(), 1);
  return check_result();
}
