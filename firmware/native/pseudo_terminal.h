// The device's end of a pseudo-terminal; the host opens `name` like any serial port.
#pragma once
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <termios.h>
#include <unistd.h>

#include <string>

struct PseudoTerminal {
  int device = -1, host = -1;
  std::string name, link;

  bool open(const std::string& link_path) {
    device = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (device < 0 || grantpt(device) != 0 || unlockpt(device) != 0) return false;
    name = ptsname(device);
    host = ::open(name.c_str(), O_RDWR | O_NOCTTY | O_CLOEXEC);  // held, so that a host may come and go
    if (host < 0) return false;
    termios settings;
    if (tcgetattr(host, &settings) != 0) return false;
    cfmakeraw(&settings);
    if (tcsetattr(host, TCSANOW, &settings) != 0) return false;
    if (link_path.empty()) return true;
    if (symlink(name.c_str(), link_path.c_str()) != 0) return false;
    link = link_path;
    return true;
  }

  ~PseudoTerminal() {
    if (!link.empty()) unlink(link.c_str());
    if (host >= 0) close(host);
    if (device >= 0) close(device);
  }

  // Like a UART: what the host does not fetch is lost, and nobody waits for it.
  void send(const char* data, size_t length) {
    while (length > 0) {
      const ssize_t sent = write(device, data, length);
      if (sent < 0 && errno == EINTR) continue;
      if (sent <= 0) return;
      data += sent;
      length -= static_cast<size_t>(sent);
    }
  }
};
