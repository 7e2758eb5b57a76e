// Grasps for a cloud, with libcurl and nlohmann-json; the body is raw float32, as a program has it in memory.
//
//   apt-get install g++ libcurl4-openssl-dev nlohmann-json3-dev
//   g++ -std=c++17 -Wall -Wextra -o grasps examples/cpp/grasps.cpp -lcurl
//   ./grasps [URL [CLOUD.npy]]
//
// For little-endian machines, whose floats the service takes as they are.
#include <curl/curl.h>

#include <cstdio>
#include <cstring>
#include <exception>
#include <fstream>
#include <iterator>
#include <memory>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <string>
#include <vector>

using nlohmann::json;

// x, y, z in metres, one point after the other, of a .npy file (version 1) that numpy wrote from float32 (N, 3).
std::vector<float> read_points(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error("cannot read " + path);
    const std::string bytes{std::istreambuf_iterator<char>(file), {}};
    if (bytes.rfind("\x93NUMPY\x01", 0) != 0 || bytes.size() < 10) throw std::runtime_error(path + " is no .npy file");
    const auto byte = [&](std::size_t at) { return static_cast<std::size_t>(static_cast<unsigned char>(bytes[at])); };
    const std::size_t start = 10 + byte(8) + 256 * byte(9);
    if (start > bytes.size() || bytes.find("'descr': '<f4', 'fortran_order': False") > start)
        throw std::runtime_error(path + " does not hold float32 rows");
    std::vector<float> points((bytes.size() - start) / sizeof(float));
    std::memcpy(points.data(), bytes.data() + start, points.size() * sizeof(float));
    return points;
}

struct Answer {
    long status = 0;
    json document;
};

// POST /grasps with the options in the query string, each value as URL-encoded JSON.
Answer post_grasps(const std::string& url, const std::vector<float>& points, const json& options) {
    const std::unique_ptr<CURL, decltype(&curl_easy_cleanup)> curl(curl_easy_init(), curl_easy_cleanup);
    if (!curl) throw std::runtime_error("libcurl cannot start");
    std::string address = url + "/grasps";
    char separator = '?';
    for (const auto& [name, value] : options.items()) {
        const std::unique_ptr<char, decltype(&curl_free)> text(
            curl_easy_escape(curl.get(), value.dump().c_str(), 0), curl_free);
        address += separator + name + "=" + text.get();
        separator = '&';
    }
    const std::unique_ptr<curl_slist, decltype(&curl_slist_free_all)> headers(
        curl_slist_append(nullptr, "Content-Type: application/octet-stream"), curl_slist_free_all);
    std::string body;
    const auto append = +[](char* data, std::size_t, std::size_t size, void* to) {
        static_cast<std::string*>(to)->append(data, size);
        return size;
    };
    curl_easy_setopt(curl.get(), CURLOPT_URL, address.c_str());
    curl_easy_setopt(curl.get(), CURLOPT_HTTPHEADER, headers.get());
    curl_easy_setopt(curl.get(), CURLOPT_POSTFIELDS, reinterpret_cast<const char*>(points.data()));
    curl_easy_setopt(curl.get(), CURLOPT_POSTFIELDSIZE_LARGE, static_cast<curl_off_t>(points.size() * sizeof(float)));
    curl_easy_setopt(curl.get(), CURLOPT_TIMEOUT, 60L);
    curl_easy_setopt(curl.get(), CURLOPT_WRITEFUNCTION, append);
    curl_easy_setopt(curl.get(), CURLOPT_WRITEDATA, &body);
    if (const CURLcode code = curl_easy_perform(curl.get()); code != CURLE_OK)
        throw std::runtime_error(url + ": " + curl_easy_strerror(code));
    Answer answer;
    curl_easy_getinfo(curl.get(), CURLINFO_RESPONSE_CODE, &answer.status);
    answer.document = json::parse(body);
    return answer;
}

int main(int count, char** arguments) try {
    const std::string url = count > 1 ? arguments[1] : "http://127.0.0.1:8000";
    const std::string cloud = count > 2 ? arguments[2] : "examples/clutter.npy";
    const json options = {
        {"viewpoint", {0.38, 0.55, 0.48}}, {"up", {0, 0, 1}}, {"support_height", 0.05}, {"max_grasps", 5}};

    curl_global_init(CURL_GLOBAL_DEFAULT);
    const Answer answer = post_grasps(url, read_points(cloud), options);
    curl_global_cleanup();

    if (answer.status != 200)
        throw std::runtime_error(std::to_string(answer.status) + ": " + answer.document.at("detail").get<std::string>());
    const json& grasps = answer.document.at("grasps");
    if (grasps.empty()) std::printf("no grasps: %s\n", answer.document.at("reason").get<std::string>().c_str());
    for (const json& grasp : grasps) {
        const auto tcp = grasp.at("position").get<std::vector<double>>();
        std::printf("%.2f  TCP at %.3f %.3f %.3f  opening %.3f m\n", grasp.at("score").get<double>(), tcp.at(0),
                    tcp.at(1), tcp.at(2), grasp.at("width").get<double>());
    }
} catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
}
