"""The real sensor with all that is public: data of several kinds, and the likelihood of effects given all of them."""
