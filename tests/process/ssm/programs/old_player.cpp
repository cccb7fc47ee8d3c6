// SPDX-License-Identifier: Apache-2.0
//
// A player as programs for SSM have it, unedited: plays logs of any type by the shared clock.
// Arguments: LOG...
#include <libssm.h>
#include <stdlib.h>

#include <iostream>
#include <list>
#include <ssm-log.hpp>
#include <ssm.hpp>

using namespace std;

class Player {
  SSMLogBase log;
  SSMApiBase con;
  void* data;
  void* property;
  bool playing;

 public:
  Player() : data(NULL), property(NULL), playing(false) {}

  bool open(const char* fileName) {
    if (!log.open(fileName)) return false;
    data = malloc(log.dataSize());
    property = malloc(log.propertySize());
    log.setBuffer(data, log.dataSize(), property, log.propertySize());
    con.setBuffer(data, log.dataSize(), property, log.propertySize());
    if (log.propertySize() > 0) log.readProperty();
    ssmTimeT life = calcSSM_life(log.getBufferNum(), log.getCycle());
    if (!con.create(log.getStreamName(), log.getStreamId(), life, log.getCycle())) return false;
    if (log.propertySize() > 0) con.setProperty();
    playing = log.read();
    return true;
  }
  bool play() {
    while (playing && log.time() <= gettimeSSM()) {
      con.write(log.time());
      playing = log.readNext();
    }
    return playing;
  }
  ssmTimeT start() { return log.getStartTime(); }
  void close() {
    log.close();
    con.release();
    free(data);
    free(property);
  }
};

int main(int argc, char** argv) {
  if (!initSSM()) return 1;
  settimeSSM_is_pause(1);
  list<Player> players;
  ssmTimeT start = 0;
  for (int i = 1; i < argc; i++) {
    players.push_back(Player());
    if (!players.back().open(argv[i])) return 1;
    if (i == 1 || players.back().start() < start) start = players.back().start();
  }
  settimeSSM(start);
  settimeSSM_is_pause(0);
  bool playing = true;
  while (playing) {
    playing = false;
    for (list<Player>::iterator p = players.begin(); p != players.end(); p++) {
      if (p->play()) playing = true;
    }
    usleepSSM(1000);
  }
  for (list<Player>::iterator p = players.begin(); p != players.end(); p++) p->close();
  inittimeSSM();
  endSSM();
  cout << "end" << endl;
  return 0;
}
